"""Formats carry numbers; a file of an earlier number is read by its migration, one of a later number is refused."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import pytest

from bridge.policy import AGENT_KIND
from bridge.policy import KIND as POLICY
from bridge.policy import SCHEMA as POLICY_SCHEMA
from sysid.logs.log import read_fields
from sysid.pages.report import KIND as REPORT
from sysid.pages.report import read_report
from whill_mjx.io import formats
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.vehicle_file import KIND as VEHICLE
from whill_mjx.vehicle.vehicle_file import load_vehicle, save_vehicle

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.quick


def test_the_page_lists_every_format_with_its_number():
    rows = re.findall(r"^\| `(.+?)` \| `(.+?)` \| (\d+) \|", (ROOT / "docs" / "formats.md").read_text(), re.MULTILINE)
    assert rows == [(one.kind, one.file, str(one.schema)) for one in formats.FORMATS.values()]


def test_the_bridge_reads_the_number_that_is_listed():
    assert {formats.FORMATS[kind].schema for kind in (POLICY, AGENT_KIND)} == {POLICY_SCHEMA}


def test_a_vehicle_of_an_earlier_number_is_read_by_its_migration(tmp_path, monkeypatch):
    path = save_vehicle(tmp_path / "vehicle.toml", *preset("whill_cr"))
    old = path.read_text().replace("schema = 1", "schema = 0").replace("wheel_radius", "radius_of_wheels")
    assert tomllib.loads(old)["schema"] == 0
    path.write_text(old)
    with pytest.raises(ValueError, match="schema is 0; this version reads schema 1"):
        load_vehicle(path)

    def renamed(content):
        spec = dict(content["spec"])
        return {**content, "spec": {"wheel_radius": spec.pop("radius_of_wheels"), **spec}}

    monkeypatch.setitem(formats.MIGRATIONS, VEHICLE, {0: renamed})
    assert load_vehicle(path)[0] == preset("whill_cr")[0]


def test_a_log_and_a_fit_of_an_earlier_number_are_read_by_their_migrations(tmp_path, monkeypatch):
    (tmp_path / "dataset.toml").write_text((ROOT / "sysid/data/chair/dataset.toml").read_text().replace(
        "schema = 1", "schema = 0"))
    monkeypatch.setitem(formats.MIGRATIONS, "driving-log-dataset", {0: dict})
    assert read_fields(tmp_path / "dataset.toml")["schema"] == 1
    empty = {name: {} for name in ("dataset", "settings", "model", "noise", "summary", "search")}
    lists = {name: [] for name in ("parameters", "fixed", "errors")}
    (tmp_path / "report.json").write_text(json.dumps({"schema": 0, "kind": REPORT, **empty, **lists}))
    monkeypatch.setitem(formats.MIGRATIONS, REPORT, {0: dict})
    assert read_report(tmp_path)["schema"] == 1


@pytest.mark.parametrize("schema", [2, 10**9, -1, "1", True, None, 1.5])
def test_a_number_that_no_step_begins_at_is_left_to_the_reader(schema):
    assert formats.upgraded(VEHICLE, {"schema": schema}) == {"schema": schema}
