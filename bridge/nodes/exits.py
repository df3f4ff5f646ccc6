"""How the commands of this package end: one table for all of them, that of docs/reliability.md."""

from enum import IntEnum


class Exit(IntEnum):
    """Exit codes."""

    DONE = 0
    """All was done, or a node ended in order at Ctrl-C or SIGTERM."""
    FAULT = 1
    """A file or the machine is at fault: a damaged policy file, no ROS, a full disk."""
    REFUSED = 2
    """The command is at fault: an option, or what it asks for does not fit. Nothing was touched."""
    SHORT = 3
    """It ended in order, before all was there that was asked for: no odometry came, replicates are missing."""
    STOPPED = 130
    """Ctrl-C before the node ran."""


class OptionError(ValueError):
    """A command that cannot be meant: it names the option, its value, the rule and the remedy."""


def refusal(error: Exception) -> Exit:
    """Return the exit code for an error that ends a command before it begins."""
    return Exit.REFUSED if isinstance(error, OptionError) else Exit.FAULT
