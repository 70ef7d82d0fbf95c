"""Pages of a file or a folder that grows: served to this machine alone, made anew when
what they show has changed.
"""

import html
import os
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock
from urllib.parse import quote, unquote_to_bytes, urlsplit

from metalens.ground import reading
from metalens.ground.errors import ConfigError, MetalensError, OutputError

Make = Callable[[Path], str]
HOME, STAMP = "/", "/stamp"
_EVERY_MS = 2000
_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; connect-src 'self'"
# asks whether what the page shows has changed; a page that is being read (a slider in
# hand) is not torn away
_ASK = """<script>(() => { const at = location.pathname; let held = null;
setInterval(async () => { try { const now = await (await fetch("/stamp" + at)).text();
if (held !== null && now !== held && document.visibilityState === "visible") location.reload();
held = now; } catch {} }, %d); })();</script>"""


class Server(ThreadingHTTPServer):
    """Pages of one artefact, or of every artefact of a folder with a list of them in
    front.

    Only this machine can ask (127.0.0.1, and no other name in the request), only what
    lies in the folder is shown.
    Pages are kept until their files change.

    Args:
        root: what is shown. make: the page of one artefact. listed: artefacts below the
            root; none: the root is one.
        port: 0 for any that is free.

    Raises:
        OutputError: the port is taken or not allowed.
    """

    daemon_threads = True

    def __init__(
        self, root: Path, make: Make, listed: Callable[[], list[Path]], *, port: int = 0
    ) -> None:
        self.root, self.make, self.listed = root, make, listed
        self._kept: dict[str, tuple[str, str]] = {}
        self._one = Lock()
        try:
            super().__init__(("127.0.0.1", port), _Handler)
        except (OSError, OverflowError) as error:
            raise OutputError(
                f"port {port} cannot be used ({error}); give another --port, or 0 for any"
            ) from None

    @property
    def address(self) -> str:
        """Where a browser finds the pages."""
        return f"http://127.0.0.1:{self.server_address[1]}/"

    def target(self, path: str) -> Path | None:
        """The artefact that a page's path names; None: there is none."""
        if path == HOME:
            return self.root
        named = {
            f"/{_link(one.relative_to(self.root).as_posix())}": one
            for one in self.listed()
        }
        return named.get(quote(unquote_to_bytes(path)))

    def page(self, path: str) -> str | None:
        """The page of a path, made anew if its files have changed; what cannot be read
        says why.
        """
        target = self.target(path)
        if target is None:
            return None
        with self._one:
            now = stamp(target)
            if self._kept.get(path, ("", ""))[0] != now:
                self._kept[path] = (now, self._made(target))
            return self._kept[path][1]

    def _made(self, target: Path) -> str:
        listed = self.listed() if target == self.root else []
        try:
            body = _list(self.root, listed) if listed else self.make(target)
        except (MetalensError, OSError) as error:
            body = _plain(
                target.name, f"<p>cannot be shown now: {html.escape(str(error))}</p>"
            )
        return body.replace("</body>", _ASK % _EVERY_MS + "</body>")


class _Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        """A page, or the stamp of what a page shows."""
        host = self.headers.get("Host", "").rsplit(":", 1)[0]
        if host not in ("127.0.0.1", "localhost"):
            self.send_error(HTTPStatus.FORBIDDEN, "only this machine is answered")
            return
        path = urlsplit(self.path).path
        if path.startswith(STAMP + "/"):
            target = self.server.target(path.removeprefix(STAMP))
            self._answer(None if target is None else stamp(target), "text/plain")
        else:
            self._answer(self.server.page(path), "text/html")

    def _answer(self, text: str | None, kind: str) -> None:
        if text is None:
            self.send_error(HTTPStatus.NOT_FOUND, "no artefact of this folder")
            return
        content = reading.shown(text).encode()
        self.send_response(HTTPStatus.OK)
        for name, value in (("Content-Type", f"{kind}; charset=utf-8"), ("Content-Length", str(len(content))),
                            ("Cache-Control", "no-store"), ("Content-Security-Policy", _POLICY)):  # fmt: skip
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Requests are not told: the terminal is the user's."""


def stamp(path: Path) -> str:
    """Changes when a file, or any file of a folder, does: names, sizes and times."""
    seen = []
    for one in sorted(path.rglob("*")) if path.is_dir() else [path]:
        try:
            about = one.stat()
        except OSError:  # gone since it was listed
            continue
        if not one.is_dir():
            seen.append(f"{one} {about.st_size} {about.st_mtime_ns}")
    return f"{hash(tuple(seen)):x}"


def serve(
    root: Path,
    make: Make,
    listed: Callable[[], list[Path]],
    *,
    port: int,
    ready: Callable[[str], None],
) -> None:
    """Serve until interrupted.

    Args:
        ready: is told the address when the server listens.

    Raises:
        ConfigError: nothing is there to show. OutputError: the port cannot be used.
    """
    if not root.exists():
        raise ConfigError(f"{root}: no such file or folder")
    with Server(root, make, listed, port=port) as server:
        ready(server.address)
        try:
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            return


def _list(root: Path, listed: list[Path]) -> str:
    names = [one.relative_to(root).as_posix() for one in listed]
    rows = "".join(
        f'<li><a href="/{_link(name)}">{html.escape(name)}</a></li>' for name in names
    )
    return _plain(
        root.resolve().name,
        f"<p>{len(names)} to look at; the page follows the folder.</p><ul>{rows}</ul>",
    )


def _link(name: str) -> str:
    """A name of a file, whatever its bytes, as part of an address."""
    return quote(os.fsencode(name))


def _plain(title: str, body: str) -> str:
    return _PLAIN.format(html.escape(title), body)


_PLAIN = (
    "<!doctype html><html lang='en'><head><meta charset='utf-8'><meta name='viewport' content='width=device-width'>"
    "<title>{0}</title><style>:root{{color-scheme:light dark}}body{{font:16px/1.6 system-ui;max-width:60rem;"
    "margin:2rem auto;padding:0 1rem;overflow-wrap:anywhere}}</style></head><body><main><h1>{0}</h1>{1}</main>"
    "</body></html>"
)
