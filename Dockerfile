# The command line in a container: docker build -t metalens . && docker run --rm -v "$PWD:/work" metalens --help
FROM python:3.11-slim
RUN useradd --create-home maker
COPY . /src
RUN pip install --no-cache-dir -c /src/constraints.txt torch numpy \
    && pip install --no-cache-dir -c /src/constraints.txt "/src[all]" && rm -rf /src
USER maker
WORKDIR /work
ENTRYPOINT ["metalens"]
