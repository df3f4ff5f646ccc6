"""The plots of a first drive, of a recording that is written here."""

from __future__ import annotations

import pytest

from benchmarks import deploy_plots
from bridge.recording.trial_writer import COLUMNS


@pytest.fixture
def draw(tmp_path, monkeypatch):
    """Draws a trial of ten rows with more words of a command line."""
    monkeypatch.chdir(tmp_path)
    for stream in ("command", "odometry"):
        rows = [",".join([f"{0.1 * k:.1f}", *["0.5"] * (len(COLUMNS[stream]) - 1)]) for k in range(10)]
        (tmp_path / f"{stream}.csv").write_text("\n".join([",".join(COLUMNS[stream]), *rows]) + "\n")

    def call(*words):
        monkeypatch.setattr("sys.argv", ["deploy_plots", str(tmp_path), *words])
        deploy_plots.main()

    return call


@pytest.mark.parametrize("words, name", [(("--out", "first.png"), "first.png"), ((), "first_drive.png")])
def test_a_picture_of_somebody_is_not_replaced(draw, tmp_path, capsys, words, name):
    draw(*words)
    draw(*words)  # as the command wrote it
    (tmp_path / name).write_bytes(b"mine")
    with pytest.raises(SystemExit) as ended:
        draw(*words)
    assert ended.value.code == 2 and f"{name}: exists already" in capsys.readouterr().err
    assert (tmp_path / name).read_bytes() == b"mine"
