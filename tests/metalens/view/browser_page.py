"""A page in a headless browser that tells the test what it drew: no clock, the browser
is ended when it has spoken.
"""

import http.server
import shutil
import subprocess
import threading
from pathlib import Path

BROWSER = (
    shutil.which("chromium")
    or shutil.which("chromium-browser")
    or shutil.which("google-chrome")
)
_PATIENCE_S = 300  # a browser that has not spoken by then has crashed
_TELL = """<script>(async () => {
const drawn = () => document.body.dataset.ready === "true";
await new Promise((go) => {
  const watch = new MutationObserver(() => drawn() && go());
  if (drawn()) go(); else watch.observe(document.body, { attributes: true });
});
await new Promise((go) => setTimeout(() => requestAnimationFrame(() => setTimeout(go, 0)), 0));
const told = String((() => { %s })());
await fetch("http://127.0.0.1:%d/", { method: "POST", mode: "no-cors", body: told });
})();</script></body>"""


def told(path: Path, script: str, *, width: int = 1440) -> str:
    """What the body of a function returns in a page, once the page is drawn."""
    answer: list[str] = []
    spoken = threading.Event()

    class Listener(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            answer.append(self.rfile.read(int(self.headers["Content-Length"])).decode())
            self.send_response(204)
            self.end_headers()
            spoken.set()

        def log_message(self, format: str, *args: object) -> None:
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Listener) as server:
        threading.Thread(
            target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True
        ).start()
        asking = path.with_name(f"asking_{path.name}")
        tell = _TELL % (script, server.server_address[1])
        asking.write_text(
            path.read_text(encoding="utf-8").replace("</body>", tell), encoding="utf-8"
        )
        words = [
            BROWSER,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--no-first-run",
            "--remote-debugging-port=0",
        ]
        words += [
            "--disable-background-networking",
            f"--user-data-dir={path.parent / 'profile'}",
        ]
        words += [f"--window-size={width},1200", asking.as_uri()]
        with subprocess.Popen(
            words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ) as browser:
            heard = spoken.wait(_PATIENCE_S)
            browser.terminate()
        server.shutdown()
    assert heard, "the browser ended without drawing the page"
    return answer[0]
