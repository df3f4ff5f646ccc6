"""The page of runs, live on this machine alone: a browser loads it again when something has changed."""

from __future__ import annotations

import base64
import hashlib
import html
import sys
import threading
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from whill_mjx.browser.page import MEDIA_BYTES, POLICY, runs_page
from whill_mjx.browser.read import Run, find_runs, inside, read_runs

HOST = "127.0.0.1"
TYPES = {".html": "text/html; charset=utf-8", ".png": "image/png", ".gif": "image/gif", ".mp4": "video/mp4"}
"""Files of a run that are served; no others."""
REPORT = ("sandbox; default-src 'none'; img-src 'self' data:; media-src 'self' data:; style-src 'unsafe-inline'")
"""What a browser may do with a report of a run, which others may have written."""
EVERY_S = 2.0
"""Time between two questions of the browser whether something has changed [s]."""
SCRIPT = """
let seen = null;
setInterval(async () => {
  try {
    const now = await (await fetch("version")).text();
    if (seen !== null && now !== seen) location.reload();
    seen = now;
  } catch (error) { document.title = "(stopped) " + document.title.replace(/^\\(stopped\\) /, ""); }
}, EVERY_MS);
"""


class Site:
    """The runs of some paths as they are now."""

    def __init__(self, paths: Sequence[Path], embed: int = MEDIA_BYTES, every_s: float = EVERY_S) -> None:
        """Remember what to show, and how often a browser asks whether it has changed; nothing is read yet."""
        self._paths, self._embed, self._every_s = list(paths), embed, every_s
        self._lock = threading.Lock()
        self._made, self._page = "", ""
        self._runs: list[Run] = []

    def version(self) -> str:
        """Changes when a file of the runs does."""
        digest = hashlib.sha256()
        for folder in find_runs(self._paths):
            for path in sorted((*folder.glob("*"), *folder.glob("fit/*"))):
                try:
                    about = path.stat()
                except OSError:
                    continue  # gone meanwhile
                digest.update(f"{path}\0{about.st_mtime_ns}\0{about.st_size}\n".encode())
        return digest.hexdigest()[:16]

    def page(self) -> str:
        """The page, made again where something has changed."""
        with self._lock:
            now = self.version()
            if now != self._made:
                self._runs = read_runs(find_runs(self._paths))
                self._page = runs_page(self._runs, self._address, self._embed, _head(self._every_s))
                self._made = now
            return self._page

    def file(self, address: str) -> Path | None:
        """The file of a run at an address of `page`; None where there is none to serve."""
        self.page()
        part, _, name = address.removeprefix("run/").partition("/")
        if not address.startswith("run/") or not part.isdecimal() or int(part) >= len(self._runs):
            return None
        run = self._runs[int(part)].path
        path = run / unquote(name)
        served = path.suffix in TYPES and inside(run, path) and not path.name.startswith(".") and path.is_file()
        return path if served else None

    def _address(self, run: Run, path: Path) -> str:
        number = next(k for k, one in enumerate(self._runs) if one is run)
        return f"run/{number}/{quote(path.relative_to(run.path).as_posix())}"


def make_server(site: Site, port: int) -> ThreadingHTTPServer:
    """A server of a site on the loopback; port 0 takes a free one. OSError where the port is taken."""
    return _Server((HOST, port), _handler(site))


class _Server(ThreadingHTTPServer):
    """Goes on in silence where a browser has gone before it had its answer."""

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)


def _handler(site: Site) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        """Answers GET alone, and only where the browser asked for this machine by name."""

        def do_GET(self) -> None:
            host = (self.headers.get("Host") or "").rpartition(":")[0]
            if host not in (HOST, "localhost"):
                return self._answer(403, b"only for this machine", "text/plain")  # a name that was bent to it
            address = self.path.partition("?")[0].lstrip("/")
            try:
                self._serve(address)
            except (OSError, ValueError) as error:
                self._answer(503, str(error).encode("utf-8", "replace"), "text/plain; charset=utf-8")

        def _serve(self, address: str) -> None:
            if address == "":
                return self._answer(200, site.page().encode(), TYPES[".html"])
            if address == "version":
                return self._answer(200, site.version().encode(), "text/plain")
            path = site.file(address)
            if path is None:
                return self._answer(404, b"no such file", "text/plain")
            more = {"Content-Security-Policy": REPORT} if path.suffix == ".html" else {}
            self._answer(200, path.read_bytes(), TYPES[path.suffix], more)

        def _answer(self, status: int, content: bytes, kind: str, more: dict[str, str] | None = None) -> None:
            self.send_response(status)
            for name, value in {"Content-Type": kind, "Content-Length": str(len(content)), "Cache-Control": "no-store",
                                "X-Content-Type-Options": "nosniff", **(more or {})}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *values: Any) -> None:
            """Say nothing: the browser asks every few seconds."""

    return Handler


def _head(every_s: float) -> str:
    """The page's own script, and a policy that allows no other."""
    script = SCRIPT.replace("EVERY_MS", f"{1000 * every_s:.0f}")
    known = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = html.escape(f"{POLICY}; script-src 'sha256-{known}'; connect-src 'self'")
    return f'<meta http-equiv="Content-Security-Policy" content="{policy}"><script>{script}</script>'
