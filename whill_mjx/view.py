"""Show runs on one page in a browser: curves, drives, videos, reports and settings side by side.

    python -m whill_mjx.view RUN... [--out view.html]       # one file that needs nothing else
    python -m whill_mjx.view RUN... --serve                 # live while they train, on this machine alone

RUN is what a command wrote by --out: a training, an evaluation, a fit, a loop; or a folder of such folders.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from whill_mjx.io.command_line import NOT_NEGATIVE, OptionError, Range, With, listen, refusing, run, starts

if starts(__name__):
    listen()

import tyro

from whill_mjx.browser.page import relative_links, runs_page
from whill_mjx.browser.read import find_runs, read_runs
from whill_mjx.io.folders import check_file, note_written, write_whole


@dataclass(frozen=True)
class ViewOptions:
    """Options of the command."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs, or folders of such folders."""
    out: Path = Path("view.html")
    """File to write; an earlier one is replaced."""
    serve: bool = False
    """Write nothing; serve the page to browsers of this machine until the command is stopped."""
    port: Annotated[int, Range(0, 65535), With("serve")] = 8642
    """Port on the loopback; 0 takes a free one."""
    embed_mb: Annotated[float, NOT_NEGATIVE] = 40.0
    """Megabytes of pictures and videos to put into the page; others are linked."""


def main(options: ViewOptions) -> Path | None:
    """Write the page and return its path, or serve it."""
    with refusing():
        if not options.runs:
            raise ValueError("RUN: none is given. Name the folder that a command wrote by --out.")
        folders = find_runs(options.runs)
        if not options.serve:
            if options.out.suffix != ".html":
                raise OptionError(f"--out {options.out}: must be a file that ends in .html. Correct the name.")
            check_file("--out", options.out)
    embed = round(1e6 * options.embed_mb)
    if options.serve:
        serve(options, embed)
        return None
    runs = read_runs(folders)
    write_whole(options.out, runs_page(runs, relative_links(options.out), embed))
    note_written(options.out)
    for one in runs:
        print(f"{one.name}: {one.kind}, {one.state}. {one.sentence}")
    print(f"wrote {options.out}: open it in a browser")
    return options.out


def serve(options: ViewOptions, embed: int) -> None:
    """Serve until a signal comes."""
    from whill_mjx.browser.serve import HOST, Site, make_server

    with refusing():
        try:
            server = make_server(Site(options.runs, embed), options.port)
        except OSError as error:
            raise OptionError(f"--port {options.port}: cannot be used ({error.strerror}). Choose another one, or 0."
                              ) from None
    with server:
        print(f"open http://{HOST}:{server.server_address[1]}/ in a browser; stop with Ctrl-C", flush=True)
        server.serve_forever()


def cli() -> None:
    """Command line."""
    run(ViewOptions, main, __doc__, positional=False, stopped="stopped.")


if __name__ == "__main__":
    cli()
