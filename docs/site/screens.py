"""Pictures of every page of a demo, for docs/gallery/pages: as on a desk, in the dark,
on a phone, on paper.

    metalens demo demo; python docs/site/screens.py demo

Needs chromium; on paper also pypdfium2 (``pip install pypdfium2``), without which that
picture is left out.
"""

import importlib.util
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

PAGES = Path(__file__).parents[1] / "gallery" / "pages"
BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
HIGH = 1500  # px of a page that are shown, from its top
SHOWN = {  # artefact of the demo: name of the picture
    "library.h5": "library",
    "lens.h5": "lens",
    "psf.h5": "psf",
    "mask": "mask",
    "captures": "captures",
    "asbuilt.h5": "asbuilt",
    "run": "run",
    "image/image.h5": "image",
}
FRAME = '<body style="margin:0"><iframe src="{}" width="{}" height="{}" style="border:0"></iframe>'


def shot(page: Path, folder: Path, *, width: int, dark: bool = False) -> Image.Image:
    """The top of a page in a window of this width (a frame of it: windows have a least
    width).
    """
    frame, picture = folder / "frame.html", folder / "shot.png"
    frame.write_text(FRAME.format(page.as_uri(), width, HIGH), encoding="utf-8")
    mode = (
        ["--force-dark-mode", "--blink-settings=preferredColorScheme=0"] if dark else []
    )
    _browse(*mode, "--allow-file-access-from-files", f"--window-size={max(width, 600)},{HIGH}", "--hide-scrollbars",
            f"--screenshot={picture}", frame.as_uri())  # fmt: skip
    return Image.open(picture).convert("RGB").crop((0, 0, width, HIGH))


def paper(page: Path, folder: Path) -> list[Image.Image]:
    """The first sheet as printed; nothing without a reader of PDF."""
    if importlib.util.find_spec("pypdfium2") is None:
        return []
    import pypdfium2

    _browse(
        "--no-pdf-header-footer", f"--print-to-pdf={folder / 'page.pdf'}", page.as_uri()
    )
    return [
        pypdfium2.PdfDocument(folder / "page.pdf")[0]
        .render(scale=1.8)
        .to_pil()
        .convert("RGB")
    ]


def _browse(*words: str) -> None:
    common = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--virtual-time-budget=20000",
    ]
    subprocess.run([str(BROWSER), *common, *words], check=True, capture_output=True)


def sheet(page: Path, target: Path) -> None:
    """A page in its four forms beside each other, half as large, in 200 colours."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        parts = [
            shot(page, folder, width=1440),
            shot(page, folder, width=1440, dark=True),
        ]
        parts += [shot(page, folder, width=390), *paper(page, folder)]
    small = [
        one.resize(
            (one.width * HIGH // one.height // 2, HIGH // 2), Image.Resampling.LANCZOS
        )
        for one in parts
    ]
    made = Image.new(
        "RGB", (sum(one.width + 20 for one in small) - 20, HIGH // 2), "white"
    )
    at = 0
    for one in small:
        made.paste(one, (at, 0))
        at += one.width + 20
    made.quantize(200, dither=Image.Dither.NONE).save(target, optimize=True)


def main(demo: Path) -> int:
    """All pages of a demo; the number of parts that it lacks."""
    if BROWSER is None:
        print("no browser: install chromium")
        return 1
    PAGES.mkdir(parents=True, exist_ok=True)
    lacking = [name for name in SHOWN if not (demo / name).exists()]
    for name in lacking:
        print(f"not in {demo}: {name}")
    sheet((demo / "report.html").resolve(), PAGES / "report.png")
    with tempfile.TemporaryDirectory() as folder:
        for name, short in SHOWN.items():
            if name not in lacking:
                page = Path(folder) / f"{short}.html"
                subprocess.run(
                    [
                        sys.executable,
                        "-m",
                        "metalens",
                        "view",
                        str(demo / name),
                        "-o",
                        str(page),
                        "--quiet",
                    ],
                    check=True,
                )
                sheet(page, PAGES / f"{short}.png")
                print(
                    f"{short}.png: {(PAGES / f'{short}.png').stat().st_size / 1e3:.0f} kB",
                    flush=True,
                )
    return len(lacking)


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1])))
