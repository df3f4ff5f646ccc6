"""What users of the learner import, a line each: `python -m dreamer`."""

from __future__ import annotations

import os
import sys

import dreamer


def main() -> None:
    """Print the list: the learner has no command of its own."""
    print("The learner has no command of its own: python -m whill_mjx.train trains with it. From Python:")
    for name in dreamer.__all__:
        about = (getattr(dreamer, name).__doc__ or "").splitlines()[0]
        print(f"  dreamer.{name:<16} {about}")


if __name__ == "__main__":
    try:
        main()
        sys.stdout.flush()
    except BrokenPipeError:  # nobody reads on, as `| head` does not
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None
