"""Pages served to this machine: they follow what grows, and show nothing outside the
folder.
"""

import functools
import http.client
import signal
import subprocess
import sys
import threading
import urllib.request
from contextlib import contextmanager

import numpy as np
import pytest

from metalens import lens
from metalens.cell import Cell, Index
from metalens.commands import view
from metalens.ground.errors import ConfigError, OutputError
from metalens.lens import DiameterMap, Lens
from metalens.proxy import Proxy
from metalens.view.server import Server, stamp


def _lens(path, largest_um):
    proxy = Proxy(
        np.array([[8.0, 3.5]]), np.array([[0.9]]), (0.08, 0.21), (0.85, 0.85), 0.0, 0.0
    )
    diameters = np.linspace(0.08, largest_um, 63, dtype=np.float32).reshape(7, 9)
    made = Lens(
        DiameterMap(diameters, 0.3),
        Cell(0.3, pillar=Index(3.6)),
        proxy,
        0.85,
        2000.0,
        20_000.0,
        "map",
    )
    lens.save(path, made)


@contextmanager
def _served(root, make, listed=list):
    with Server(root, make, listed) as server:
        threading.Thread(
            target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True
        ).start()
        try:
            yield server
        finally:
            server.shutdown()


def _get(server, path, host=None):
    asked = http.client.HTTPConnection("127.0.0.1", server.server_address[1])
    asked.request("GET", path, headers={"Host": host} if host else {})
    answer = asked.getresponse()
    return answer.status, answer.read().decode()


def test_a_page_is_made_anew_only_when_its_file_changes(tmp_path):
    file = tmp_path / "lens.h5"
    file.write_text("one")
    made = []
    with _served(
        file, lambda path: made.append(path) or f"<body>{path.read_text()}</body>"
    ) as server:
        before = _get(server, "/stamp/")[1]
        assert _get(server, "/")[1].startswith("<body>one")
        assert _get(server, "/")[1].startswith("<body>one")
        assert len(made) == 1
        file.write_text("other")
        assert _get(server, "/stamp/")[1] != before
        assert _get(server, "/")[1].startswith("<body>other")


def test_only_artefacts_of_the_folder_and_only_this_machine(tmp_path):
    inside = tmp_path / "shown" / "a b.h5"
    inside.parent.mkdir()
    inside.write_text("it")
    (tmp_path / "secret").write_text("no")
    with _served(
        inside.parent, lambda path: f"<body>{path.read_text()}</body>", lambda: [inside]
    ) as server:
        assert 'href="/a%20b.h5"' in _get(server, "/")[1]
        assert _get(server, "/a%20b.h5")[1].startswith("<body>it")
        for path in (
            "/../secret",
            "/%2e%2e/secret",
            "//etc/passwd",
            "/secret",
            "/stamp/../secret",
        ):
            assert _get(server, path)[0] == 404
        assert (
            _get(server, "/", host="elsewhere.org")[0] == 403
        )  # a name that was pointed at this machine
        assert _get(server, "/", host=f"localhost:{server.server_address[1]}")[0] == 200


def test_a_file_whose_name_is_in_no_encoding_is_listed_and_shown(tmp_path):
    inside = tmp_path / "gr\udcf6\udcdfe.h5"
    inside.write_text("it")
    with _served(
        tmp_path,
        lambda path: f"<body>{path.name} {path.read_text()}</body>",
        lambda: [inside],
    ) as server:
        assert '<a href="/gr%F6%DFe.h5">gr\\xf6\\xdfe.h5</a>' in _get(server, "/")[1]
        assert _get(server, "/gr%F6%DFe.h5")[1].startswith("<body>gr\\xf6\\xdfe.h5 it")


def test_a_file_half_written_is_said_and_shown_when_it_is_whole(tmp_path):
    file = tmp_path / "lens.h5"
    _lens(file, 0.2)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 3])

    def make(path):
        lens.load(path)
        return "<body>whole</body>"

    with _served(file, make) as server:
        assert "cannot be shown now" in _get(server, "/")[1]
        file.write_bytes(whole)
        assert _get(server, "/")[1].startswith("<body>whole")


def test_stamps_tell_changes_below_a_folder(tmp_path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "log").write_text("1")
    before = stamp(tmp_path)
    assert stamp(tmp_path) == before
    (tmp_path / "deep" / "log").write_text("12")
    assert stamp(tmp_path) != before


def test_a_taken_port_and_options_that_do_nothing_are_refused(tmp_path):
    with (
        Server(tmp_path, str, list) as server,
        pytest.raises(OutputError, match="give another --port"),
    ):
        Server(tmp_path, str, list, port=server.server_address[1])
    with pytest.raises(OutputError, match="port 99999 cannot be used"):
        Server(tmp_path, str, list, port=99999)
    with pytest.raises(ConfigError, match="only with --serve"):
        view.run(view.Options(file=tmp_path, port=8000))
    with pytest.raises(ConfigError, match="writes nothing"):
        view.run(view.Options(file=tmp_path, serve=True, output=tmp_path / "page.html"))
    with pytest.raises(ConfigError, match="no such file or folder"):
        view.run(view.Options(file=tmp_path / "absent", serve=True))


def test_the_command_serves_a_folder_until_it_is_interrupted(tmp_path):
    _lens(tmp_path / "lens.h5", 0.21)
    words = [sys.executable, "-P", "-m", "metalens", "view", str(tmp_path), "--serve"]
    heard = functools.partial(
        signal.signal, signal.SIGINT, signal.SIG_DFL
    )  # jobs in the background inherit a deaf ear
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, text=True, preexec_fn=heard
    ) as running:
        address = running.stdout.readline().split(" at ")[1].split()[0]
        with urllib.request.urlopen(address + "lens.h5") as answer:
            assert b"lens.h5 (lens)" in answer.read()
        running.send_signal(signal.SIGINT)
        assert running.wait() == 0
