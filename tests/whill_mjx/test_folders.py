"""Folders and files of a command: whole or not at all, one process at a time, never over another's."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from whill_mjx.io.folders import (
    FolderRefused,
    check_file,
    check_place,
    claim_folder,
    new_folder,
    note_written,
    write_whole,
)

pytestmark = pytest.mark.quick
KIND = "whill_mjx.test"
ROOT = Path(__file__).parents[2]


def contents(folder):
    """Every file below a folder and its bytes."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_another_run_is_refused_with_both_values_and_nothing_is_touched(tmp_path):
    with claim_folder(tmp_path, KIND) as claim:
        assert claim.identity is None
        claim.settle({"seed": 0, "task": "corridor", "limits": (0.0, 0.3)}, command={"episodes": 4})
    before = contents(tmp_path)
    assert json.loads(before["run.json"])["command"] == {"episodes": 4}
    with claim_folder(tmp_path, KIND) as claim:
        claim.settle({"seed": 0, "task": "corridor", "limits": (0.0, 0.3), "newer": 1}, command={"episodes": 9})
        with pytest.raises(FolderRefused, match=r"seed is 0 there and 7 here; task is corridor .* here. Choose"):
            claim.settle({"seed": 7, "task": "course", "limits": (0.0, 0.3)})
    after = contents(tmp_path)
    assert {**after, ".lock": b""} == {**before, ".lock": b""}


@pytest.mark.parametrize("name", ["report.html", "vehicle.toml", "policy/", "mine.csv"])
def test_a_folder_with_files_of_somebody_else_is_refused(tmp_path, name):
    path = tmp_path / name
    path.mkdir() if name.endswith("/") else path.write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(FolderRefused, match=f"holds {name.strip('/')} of something else"):
        with claim_folder(tmp_path, KIND, ("mine.csv",)):
            pytest.fail("claimed")
    assert contents(tmp_path) == before


def test_files_that_no_command_writes_may_lie_in_the_folder(tmp_path):
    (tmp_path / "log.txt").write_text("")
    with claim_folder(tmp_path, KIND):
        pass


def test_a_folder_of_another_command_or_without_a_readable_identity_is_refused(tmp_path):
    with claim_folder(tmp_path, "sysid.fit") as claim:
        claim.settle({})
    with pytest.raises(FolderRefused, match="holds results of sysid.fit, not of whill_mjx.test"):
        with claim_folder(tmp_path, KIND):
            pytest.fail("claimed")
    for text in ("{", "[]", '{"command": {}}', '{"kind": "whill_mjx.test", "identity": 3}'):
        (tmp_path / "run.json").write_text(text)
        with pytest.raises(FolderRefused, match="damaged, or of an earlier version"):
            with claim_folder(tmp_path, KIND):
                pytest.fail("claimed")


HOLD = """
import sys, time
from pathlib import Path
from whill_mjx.io.folders import claim_folder
with claim_folder(Path(sys.argv[1]), "whill_mjx.test"):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_second_process_is_refused_by_name_and_a_killed_one_leaves_no_lock(tmp_path, number):
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True,
                              cwd=ROOT)  # fmt: skip
    assert holder.stdout.readline() == "held\n"
    try:
        with pytest.raises(FolderRefused, match=rf"process {holder.pid} on .*, since 2.*, writes there"):
            with claim_folder(tmp_path, KIND):
                pytest.fail("claimed")
    finally:
        holder.send_signal(number)
        holder.wait()
    with claim_folder(tmp_path, KIND) as claim:
        claim.settle({})


def test_a_place_that_cannot_be_written_is_refused_before_the_work(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "below" / "x"):
        with pytest.raises(FolderRefused, match="is a file, not a folder"):
            with claim_folder(path, KIND):
                pytest.fail("claimed")
    with pytest.raises(FolderRefused, match="MB are free there and at least 9000000000000000 MB are needed"):
        check_place("--out", tmp_path / "new", least_free=9_000_000_000_000_000 * 1_000_000)
    monkeypatch.setattr(os, "access", lambda *_: False)  # the superuser may write everywhere
    with pytest.raises(FolderRefused, match="cannot be written"):
        check_place("--out", tmp_path / "new")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_file_is_whole_or_absent_and_no_part_of_it_stays(tmp_path):
    write_whole(tmp_path / "new" / "a.json", "one")
    assert contents(tmp_path) == {"new/a.json": b"one"}
    limited = f"""
import resource
from pathlib import Path
from whill_mjx.io.folders import write_whole
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    write_whole(Path({str(tmp_path / "new" / "a.json")!r}), "x" * 5000)
except OSError as error:
    print(error.filename)
"""
    found = subprocess.run([sys.executable, "-c", limited], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert found.stdout.strip() == str(tmp_path / "new" / "a.json")
    assert contents(tmp_path) == {"new/a.json": b"one"}


def test_a_new_folder_appears_whole_and_leftovers_of_killed_processes_are_removed(tmp_path):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    with pytest.raises(ValueError, match="bad"):
        with new_folder(tmp_path / "out") as partial:
            (partial / "a").write_text("1")
            (partial.with_name(partial.name.replace(str(os.getpid()), str(gone.pid)))).mkdir()
            raise ValueError("bad")
    assert len(list(tmp_path.iterdir())) == 1
    with new_folder(tmp_path / "out") as partial:
        (partial / "a").write_text("1")
    assert contents(tmp_path) == {"out/a": b"1"} and len(list(tmp_path.iterdir())) == 1
    with pytest.raises(FolderRefused, match="exists already"):
        with new_folder(tmp_path / "out"):
            pytest.fail("begun")


def test_a_text_with_the_name_of_a_file_that_is_not_utf_8_is_written(tmp_path):
    write_whole(tmp_path / "page.html", f"of {os.fsdecode(b'caf' + bytes([0xe9]))}, 日本")
    assert (tmp_path / "page.html").read_text(encoding="utf-8") == "of caf?, 日本"


def test_a_file_is_replaced_only_while_it_is_as_a_command_wrote_it(tmp_path):
    path = tmp_path / "next.csv"
    check_file("--out", path)
    write_whole(path, "t,v,omega\n")
    note_written(path)
    check_file("--out", path)  # the same command again
    path.write_text("t,v,omega\n0,1,0\n")  # somebody edits it
    with pytest.raises(FolderRefused, match=f"--out {path}: exists already, and is not as a command"):
        check_file("--out", path)
    path.unlink()
    check_file("--out", path)


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"\xff", b'{"mine.csv": 3}'])
def test_a_damaged_account_of_files_makes_them_somebodys(tmp_path, content):
    path = tmp_path / "mine.csv"
    path.write_text("mine")
    (tmp_path / ".mine.csv.written").write_bytes(content)
    with pytest.raises(FolderRefused, match="exists already"):
        check_file("--out", path)
    note_written(path)
    check_file("--out", path)


def test_files_that_are_written_at_once_are_all_noted(tmp_path):
    def write(name):
        for turn in range(5):
            check_file("--out", tmp_path / name)
            write_whole(tmp_path / name, f"{name} {turn}")
            note_written(tmp_path / name)

    names = [f"{number}.csv" for number in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, names))
    script = f"""
import sys
from pathlib import Path
from whill_mjx.io.folders import check_file, write_whole
path = Path({str(tmp_path)!r}) / sys.argv[1]
check_file("--out", path)
write_whole(path, sys.argv[1])
"""
    processes = [subprocess.Popen([sys.executable, "-c", script, name], cwd=ROOT) for name in ("a.png", "b.png")]
    assert [one.wait() for one in processes] == [0, 0]
    for name in (*names, "a.png", "b.png"):
        check_file("--out", tmp_path / name)


@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("there", [True, False])
def test_a_kill_before_or_after_a_file_gets_its_name_leaves_it_to_the_same_command(tmp_path, there, when):
    path = tmp_path / "page.html"
    if there:
        check_file("--out", path)
        write_whole(path, "old")
    killed = f"""
import os
from pathlib import Path
from whill_mjx.io.folders import check_file, write_whole
replace = os.replace
def until_the_kill(source, target):
    if {when == "after"}:
        replace(source, target)
    os._exit(7)
os.replace = until_the_kill
check_file("--out", Path({str(path)!r}))
write_whole(Path({str(path)!r}), "new")
"""
    assert subprocess.run([sys.executable, "-c", killed], cwd=ROOT).returncode == 7
    found = path.read_text() if path.exists() else None
    assert found == ("new" if when == "after" else "old" if there else None)
    check_file("--out", path)
    if found:
        path.write_text("edited")
        with pytest.raises(FolderRefused, match="or its note .page.html.written was lost"):
            check_file("--out", path)


def test_what_is_no_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "folder.csv").mkdir()
    for name, said in (("pipe.csv", "exists already"), ("folder.csv", "is a folder")):
        with pytest.raises(FolderRefused, match=said):
            check_file("--out", tmp_path / name)
