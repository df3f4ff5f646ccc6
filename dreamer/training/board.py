"""TensorBoard: the lines of metrics.jsonl as curves, for `tensorboard --logdir RUN`."""

from __future__ import annotations

from pathlib import Path


class Board:
    """Writes scalars over environment steps to RUN/tensorboard. Needs the package tensorboardX.

    Pretraining lies at negative steps, so that it neither shifts nor covers the counted ones.
    """

    def __init__(self, out: Path, step: int) -> None:
        """Open RUN/tensorboard; what an interrupted run wrote beyond `step` is hidden.

        Raises:
            ImportError: tensorboardX is not installed.
        """
        try:
            from tensorboardX import SummaryWriter
        except ImportError as error:
            raise ImportError(
                f"curves for TensorBoard need tensorboardX ({error}). Install it with "
                "pip install 'whill-mjx[tensorboard]', or train without them."
            ) from error
        self._writer = SummaryWriter(str(out / "tensorboard"), purge_step=step + 1)

    def write(self, line: dict[str, float], step: int) -> None:
        """One logged line at its step; names with a slash, such as eval/return, become a group."""
        for name, value in line.items():
            if name != "env_steps":
                self._writer.add_scalar(name, value, step)
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()
