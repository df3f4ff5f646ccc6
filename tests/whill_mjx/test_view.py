"""The page of runs: what it shows, that no file of a run becomes markup, and that damage is said in words."""

from __future__ import annotations

import json
import os
import queue
import re
import shutil
import socket
import struct
import subprocess
import threading
import time
import urllib.error
import urllib.request
from html.parser import HTMLParser

import numpy as np
import pytest

from whill_mjx.browser.page import relative_links, runs_page
from whill_mjx.browser.read import find_runs, read_run, read_runs
from whill_mjx.browser.serve import Site, make_server
from whill_mjx.io import html
from whill_mjx.io.command_line import OptionError
from whill_mjx.io.svg import PALETTE, Axes, Line, bar_chart, line_chart
from whill_mjx.view import ViewOptions, main

HOSTILE = '"><script>alert(1)</script><img src=x onerror=alert(2)>\'</td>'
PNG = b"\x89PNG\r\n\x1a\n" + b"x" * 20 + b"IEND\xaeB`\x82"
SHARES = {"success": 0.9, "success_interval_95": [0.8, 0.95], "episodes": 100, "collision": 0.1, "timeout": 0.0,
          "time_to_goal_s": 12.5, "return": 150.0}  # fmt: skip


def training(folder, lr=1e-4, name="obstacle_course", steps=5):
    folder.mkdir(parents=True)
    about = {"kind": "whill_mjx.train", "identity": {"task": name, "seed": 0, "dreamer.lr": lr},
             "preset": {"total_steps": 1000}}  # fmt: skip
    (folder / "run.json").write_text(json.dumps(about))
    lines = [{"env_steps": 100 * k, "eval/success": 0.1 * k, "eval/return": k, name: 1.0} for k in range(steps)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def finished(folder, **more):
    training(folder, **more)
    (folder / "evaluation.json").write_text(json.dumps({"policy": SHARES, "env_steps": 1000}))
    trace = np.cumsum(np.ones((3, 9, 2)), axis=1)
    np.savez(folder / "drives.npz", trace=trace, length=[8, 4, 8], channels=["x", "y"], success=[1, 0, 0],
             collision=[0, 1, 0])  # fmt: skip
    (folder / "drives.png").write_bytes(PNG)
    (folder / "camera.mp4").write_bytes(b"\0\0\0\x18ftypmp42moov")
    return folder


def fit(folder, text="fitted"):
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps({"kind": "sysid.fit", "identity": {"data": text}}))
    one = {"name": f"body.mass {text}", "value": 52.0, "interval": [50, 54], "unit": "kg", "identifiable": True}
    report = {"kind": "sysid-report", "schema": 1, "settings": {"seed": 0, text: text}, "parameters": [one]}
    (folder / "report.json").write_text(json.dumps(report))
    page = html.html_page(text, [], kind="Fit", lead=f"The error falls to 1 cm. {text}")
    (folder / "report.html").write_text(page)
    path = np.stack([np.arange(5.0), np.arange(5.0), np.zeros(5)], axis=1)
    arrays = {f"0.odometry.{name}": path for name in ("measured", "ideal", "initial", "fitted")}
    about = [{"name": f"circle {text}", "held_out": True, "channels": ["odometry"]}]
    np.savez(folder / "series.npz", about=np.array(json.dumps(about)), **arrays)
    return folder


def loop(folder, text="command_delay"):
    folder.mkdir(parents=True)
    effect = {"name": text, "parameters": {"delay": {"value": 0.15, "interval": [0.11, 0.19], "unit": "s"}}}
    report = {"kind": "sysid-close-loop", "schema": 1, "verdict": "named", "reason": text, "effects": [effect],
              "manifest": {"settings": {"seed": 1}, "thresholds": {"p": 0.05}}}  # fmt: skip
    (folder / "report.json").write_text(json.dumps(report))
    return folder


class Tags(HTMLParser):
    """Tags and attributes of a page, and its text."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.attributes, self.text = set(), [], ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes += attrs

    def handle_data(self, data):
        self.text += data


def page_of(*folders):
    return runs_page(read_runs(list(folders)), relative_links(folders[0].parent / "view.html"))


def test_a_training_a_fit_and_a_loop_stand_on_one_page(tmp_path):
    page = page_of(finished(tmp_path / "train"), fit(tmp_path / "fit"), loop(tmp_path / "loop"))
    text = Tags(page).text
    for wanted in ("3 runs (training, fit, missing effect): 3 finished.", "succeeds in 90% of 100 unseen episodes",
                   "The error falls to 1 cm.", "Named: command_delay.", "evaluations: success", "52.00 kg (50 to 54)",
                   "circle fitted (held out)", "3 drives", "arrived"):  # fmt: skip
        assert wanted in text, wanted
    assert 'href="./fit/report.html"' in page and "data:image/png;base64," in page and "<video" in page


def test_a_proposed_drive_is_known_by_its_page_alone(tmp_path):
    (tmp_path / "command.html").write_text('<p class="lead">Drive chirp next.</p>')
    run = read_run(tmp_path)
    assert (run.kind, run.state, run.sentence) == ("next drive", "finished", "Drive chirp next.")


def test_runs_are_shown_beside_the_page_of_a_proposed_drive(tmp_path):
    (tmp_path / "command.html").write_text('<p class="lead">Drive chirp next.</p>')
    finished(tmp_path / "train")
    assert find_runs([tmp_path]) == [tmp_path / "train", tmp_path]
    assert find_runs([tmp_path / "train"]) == [tmp_path / "train"]


@pytest.mark.parametrize("values", [[0.0, 0.0], [1.0, 1.0], [-13.6301, -13.6304], [1e-5, 2e-5]])
def test_ticks_of_a_chart_have_labels_that_differ(values):
    chart = line_chart([Line(np.arange(2.0), np.array(values))], "x", "y")
    labels = re.findall(r'text-anchor="end">([^<]*)<', chart)
    assert len(labels) > 2 and len(set(labels)) == len(labels)


def test_the_page_needs_nothing_but_itself(tmp_path):
    page = page_of(finished(tmp_path / "train"), fit(tmp_path / "fit"))
    parsed = Tags(page)
    sources = [value for name, value in parsed.attributes if name == "src"]
    assert sources and all(value.startswith("data:") for value in sources)
    assert not {"script", "link", "iframe", "object"} & parsed.tags
    assert any(name == "content" and value.startswith("default-src 'none'") for name, value in parsed.attributes)


def test_hostile_text_in_any_file_stays_text(tmp_path):
    runs = [finished(tmp_path / "a<b", name=HOSTILE), fit(tmp_path / "fit", HOSTILE), loop(tmp_path / "loop", HOSTILE)]
    (runs[0] / "x onerror=alert(3).png").write_bytes(b"no picture")
    os.mkdir(tmp_path / "kind")
    (tmp_path / "kind" / "run.json").write_text(json.dumps({"kind": HOSTILE}))
    page = page_of(*runs, tmp_path / "kind")
    parsed = Tags(page)
    assert not {"script", "iframe"} & parsed.tags and not any(name.startswith("on") for name, _ in parsed.attributes)
    assert "alert(1)" in parsed.text  # it is shown


@pytest.mark.parametrize("content", [b"", b"{", b"[1, 2]", b'{"policy": 3, "parameters": 1, "drivers": []}', b"\0\xff",
                                     b'{"kind": 7, "identity": [], "preset": 5}', b"[" * 3000,
                                     b'{"env_steps": 1e999, "x": [1]}'])  # fmt: skip
def test_a_damaged_file_is_said_in_words_and_the_rest_is_shown(tmp_path, content):
    whole = training(tmp_path / "whole")
    for name in ("run.json", "metrics.jsonl", "evaluation.json", "drives.npz", "drives.png", "camera.mp4"):
        folder = finished(tmp_path / f"of {name}")
        (folder / name).write_bytes(content)
    folder = fit(tmp_path / "fit")
    for name in ("report.json", "series.npz", "report.html"):
        (folder / name).write_bytes(content)
    text = Tags(page_of(*find_runs([tmp_path]))).text
    assert "Damaged or unfinished" in text and "drives.npz" in text and "Traceback" not in text
    assert read_run(whole).sentence in text


def test_a_half_written_last_line_is_left_out_without_a_word(tmp_path):
    folder = training(tmp_path / "run")
    with (folder / "metrics.jsonl").open("a") as file:
        file.write('{"env_steps": 90')
    run = read_run(folder)
    assert len(run.lines) == 5 and not run.problems and run.state == "stopped"
    assert run.sentence == "It was stopped at step 400 of 1,000; its last evaluation succeeds in 40% of the episodes."


def test_a_run_that_a_process_holds_is_at_work(tmp_path):
    folder = training(tmp_path / "run")
    (folder / ".lock").write_text(json.dumps({"pid": os.getpid(), "host": socket.gethostname()}))
    assert read_run(folder).state == "at work" and read_run(folder).sentence.startswith("It trains at step 400")


def test_only_what_differs_is_marked(tmp_path):
    page = page_of(training(tmp_path / "a", lr=1e-4), training(tmp_path / "b", lr=3e-4))
    marked = re.findall(r'<td class="differs">(.*?)</td>', page)
    assert marked == ["dreamer.lr", "0.0001", "0.0003"]
    assert "settings are equal in all" in page


def test_pictures_beyond_the_budget_are_linked(tmp_path):
    folder = finished(tmp_path / "a b")
    page = runs_page(read_runs([folder]), relative_links(tmp_path / "view.html"), embed=0)
    assert 'href="./a%20b/drives.png"' in page and "data:image" not in page


def test_the_command_writes_a_page_or_says_what_is_wrong(tmp_path):
    finished(tmp_path / "runs" / "one")
    out = tmp_path / "view.html"
    assert main(ViewOptions((tmp_path / "runs",), out=out)) == out and "Settings" in out.read_text()
    for wrong in (ViewOptions((tmp_path / "none",), out=out), ViewOptions((), out=out),
                  ViewOptions((tmp_path / "runs" / "one",), out=tmp_path)):  # fmt: skip
        with pytest.raises(OptionError):
            main(wrong)


@pytest.fixture
def served(tmp_path):
    folder = finished(tmp_path / "run")
    (folder / "report.html").write_text("<script>alert(1)</script>")
    (folder / "secret.toml").write_text("x")
    (folder / "out.html").symlink_to("/etc/hostname")
    server = make_server(Site([folder]), 0)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    yield folder, f"http://127.0.0.1:{server.server_address[1]}/"
    server.shutdown()
    thread.join()
    server.server_close()


def get(address, **headers):
    with urllib.request.urlopen(urllib.request.Request(address, headers=headers)) as answer:
        return answer.read().decode(), answer.headers


def test_a_live_page_changes_with_its_run(served):
    folder, address = served
    before, first = get(f"{address}version")[0], get(address)[0]
    with (folder / "metrics.jsonl").open("a") as file:
        file.write('{"env_steps": 777, "new_quantity": 1.0}\n')
    assert get(f"{address}version")[0] != before
    assert "new_quantity" not in first and "new_quantity" in get(address)[0]


def test_a_live_page_serves_reports_without_scripts_and_nothing_else(served):
    _, address = served
    assert get(f"{address}run/0/report.html")[1]["Content-Security-Policy"].startswith("sandbox; default-src 'none'")
    for wrong in ("run/0/secret.toml", "run/0/run.json", "run/0/../run/drives.png.", "run/0/%2e%2e/x.html",
                  "run/1/a.png", "run/0/out.html", "etc"):  # fmt: skip
        with pytest.raises(urllib.error.HTTPError, match="404"):
            get(address + wrong)
    with pytest.raises(urllib.error.HTTPError, match="403"):
        get(address, Host="evil.example:80")


def test_a_browser_that_goes_before_it_has_its_answer_leaves_no_traceback(served, capfd):
    folder, address = served
    (folder / "film.mp4").write_bytes(bytes(20_000_000))
    get(address)  # the page is made
    host, port = address.split("/")[2].split(":")
    with socket.create_connection((host, int(port))) as browser:
        browser.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # it closes by a reset
        browser.sendall(f"GET /run/0/film.mp4 HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode())
        browser.recv(1000)
    time.sleep(0.5)
    assert get(f"{address}version")[0] and "Traceback" not in capfd.readouterr().err


BROWSERS = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((path for name in BROWSERS if (path := shutil.which(name))), None)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_pages_fit_a_telephone_in_a_real_browser(tmp_path):
    x = np.linspace(0, 9, 50)
    blocks = [html.paragraph("long" * 200), html.table([f"column {k}" for k in range(30)], [["cell"] * 30]),
              html.charts([line_chart([Line(x, np.sin(x))], "x", "y", "t", Axes(width=900))] * 2),
              bar_chart(["a", "b"], {"s": [1.0, 2.0]}, "y", width=1100), html.bullets(["x" * 300]),
              html.legend([("n" * 40, PALETTE[0])] * 9), html.links([("p" * 200, "t")])]  # fmt: skip
    sections = [html.Section(f"Section {k}", block) for k, block in enumerate(blocks)]
    (tmp_path / "report.html").write_text(html.html_page("T" * 120, sections, "s" * 200, kind="Fit", lead="l" * 300))
    runs = finished(tmp_path / "train"), fit(tmp_path / "fit"), loop(tmp_path / "loop")
    (tmp_path / "view.html").write_text(page_of(*runs))
    frames = "".join(f'<iframe src="{name}.html" style="width:390px"></iframe>' for name in ("report", "view"))
    measure = ("[...document.querySelectorAll('iframe')].map(f => {const d = f.contentDocument, e = d.documentElement;"
               "return [e.scrollWidth, e.clientWidth, d.querySelectorAll('svg').length]})")
    (tmp_path / "measure.html").write_text(
        f"<title></title>{frames}<script>onload = () => {{document.title = JSON.stringify({measure})}}</script>")
    seen = subprocess.run(
        [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files", "--dump-dom",
         f"--user-data-dir={tmp_path / 'profile'}", (tmp_path / "measure.html").as_uri()],
        capture_output=True, text=True, timeout=600).stdout  # fmt: skip
    measured = json.loads(re.search(r"<title>(\[\[.*?\]\])</title>", seen).group(1))
    assert len(measured) == 2
    for scroll, width, charts in measured:
        assert scroll <= width <= 390 and charts >= 3


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_a_real_browser_loads_a_live_page_again_when_its_run_changes(tmp_path):
    folder, loads = training(tmp_path / "run"), queue.Queue()

    class Watched(Site):
        def page(self):
            loads.put(None)
            return super().page()

    server = make_server(Watched([folder], every_s=0.05), 0)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    browser = subprocess.Popen(
        [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0",
         f"--user-data-dir={tmp_path / 'profile'}", f"http://127.0.0.1:{server.server_address[1]}/"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # fmt: skip
    try:
        loads.get(timeout=120)
        for step in range(600):  # until the browser has seen a change; its first question may come after one
            with (folder / "metrics.jsonl").open("a") as file:
                file.write(json.dumps({"env_steps": 900 + step}) + "\n")
            try:
                loads.get(timeout=0.2)
                break
            except queue.Empty:
                continue
        else:
            pytest.fail("the browser did not load the page again")
    finally:
        browser.terminate()
        browser.wait()
        server.shutdown()
        thread.join()
        server.server_close()
