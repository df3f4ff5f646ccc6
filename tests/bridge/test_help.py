"""What --help of the bridge's commands says."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from bridge import chair, chair_joy, drive, guard, manoeuvre, record, simulate

pytestmark = pytest.mark.quick


@pytest.mark.parametrize("module", [chair, chair_joy, drive, guard, manoeuvre, record, simulate])
def test_help_is_what_is_typed_and_explains_every_option(module, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "500")
    with pytest.raises(SystemExit):
        module.parse_arguments(["--help"])
    usage, _, text = capsys.readouterr().out.partition("\n\n")
    assert usage.startswith(f"usage: python -m {module.__name__} ")
    entries = re.split(r"\n  (?=-)", text)  # an option, its value, and its help behind it or below
    without = [one for one in entries if one.startswith("--") and not re.search(r"\S(  +|\n +)\S", one)]
    assert len(entries) > 3 and not without


@pytest.mark.parametrize(("module", "shown"), [
    (drive, ["(default: 0.3)", "(default: sensing/camera/front/image_raw)", "(default: require)"]),
    (record, ["(default: 0.1325)", "(default: whill/odom)"]), (manoeuvre, ["default 1 2"]),
])  # fmt: skip
def test_help_shows_defaults_once(module, shown, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "500")
    with pytest.raises(SystemExit):
        module.parse_arguments(["--help"])
    text = capsys.readouterr().out
    assert all(one in text for one in shown)
    assert not any(line.count("default") > 1 or "inf inf" in line for line in text.splitlines())


def test_a_command_takes_no_module_of_python_from_the_folder_it_is_called_in(tmp_path):
    for name in ("json", "queue", "signal"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('of the user')\n")
    words = [sys.executable, "-m", "bridge.guard", "--help"]
    answer = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path)
    assert answer.returncode == 0 and answer.stdout.startswith("usage: python -m bridge.guard ")
