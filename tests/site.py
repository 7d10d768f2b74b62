"""What `make docs` built: is every public name in it, and what do its pages look like?

    python -m tests.site

The pictures, wide and narrow, are for somebody to look at. They need Chromium or Chrome.
"""

import functools
import http.server
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import lpo
import scb

SITE = Path("site")
WIDTHS = {"wide": 1280, "narrow": 500}
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def public_names():
    """(page of the reference, name as it is linked) of everything that the packages export."""
    for package in (scb, lpo):
        for name in package.__all__:
            home = getattr(package, name).__module__
            # Drifts are defined in modules of a package that exports them.
            home = "lpo.drifts" if home.startswith("lpo.drifts") else home
            yield f"reference_{package.__name__}", f"{home}.{name}"


def missing():
    """Names that the site's reference lacks."""
    return [
        name
        for page, name in public_names()
        if f'id="{name}"' not in (SITE / page / "index.html").read_text()
    ]


def pictures(browser):
    """Takes a picture of every page in every width; returns how many."""
    folder = SITE / "screenshots"
    folder.mkdir(exist_ok=True)
    pages = sorted({path.parent.relative_to(SITE) for path in SITE.rglob("index.html")})
    handler = functools.partial(Quiet, directory=str(SITE))
    with http.server.ThreadingHTTPServer(("localhost", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        for page in pages:
            for name, width in WIDTHS.items():
                file = folder / f"{page.name or 'index'}-{name}.png"
                command = [browser, "--headless", "--no-sandbox", "--disable-gpu"]
                command += ["--hide-scrollbars", f"--window-size={width},1600"]
                url = f"http://localhost:{server.server_port}/{page}/"
                subprocess.run(
                    [*command, f"--screenshot={file}", url], check=True, capture_output=True
                )
        server.shutdown()
    return len(pages) * len(WIDTHS)


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Says nothing of what is asked for."""

    def log_message(self, *_):
        """Nothing."""


def main():
    """Checks the names, and takes the pictures where there is a browser."""
    if names := missing():
        print(f"site: the reference lacks {', '.join(names)}.", file=sys.stderr)
        return 1
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    taken = f"{pictures(browser)} pictures in {SITE / 'screenshots'}" if browser else "no browser"
    print(f"{SITE / 'index.html'}: every public name is in the reference; {taken}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
