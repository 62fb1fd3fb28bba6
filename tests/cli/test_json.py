"""Everything that is printed or written as JSON keeps to the schemas that ship."""

import json
import shlex
from pathlib import Path

import jsonschema
import pytest
from worlds.demo import DRONE

from roadgeo.cli import main
from roadgeo.evaluation.demo import PHOTO
from roadgeo.location import Location, Reason
from roadgeo.outputs.schemas import NAMES, read_schema


@pytest.fixture(autouse=True)
def _library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROADGEO_LIBRARY", str(tmp_path))


@pytest.mark.parametrize("name", NAMES)
def test_a_schema_is_one(name: str) -> None:
    schema = read_schema(name)
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema["title"].startswith("roadgeo.")
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({"schema": "another"}, schema)


def test_results_refusals_and_errors_have_the_same_keys(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    asked = ["-r", str(porto), "--effort", "quick", "--segment", "never", "--json", "-q", "--near=-8.6,41.15,9000"]
    Path("empty.png").write_bytes(b"")
    assert main(["locate", str(DRONE), str(PHOTO), "empty.png", "--explain", *asked]) == 1
    found = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    assert main(["locate", str(DRONE), *asked[:-1], "--near=0,0,10", "-o", "refused"]) == 3
    found.append(json.loads(capfd.readouterr().out))
    for document in found:
        jsonschema.validate(document, read_schema("location"))
        assert list(document) == list(found[0])
    assert [result["reason_code"] for result in found] == ["located", "invalid", "invalid", "few_near"]
    explained = json.loads(Path("drone_explain.json").read_text())
    jsonschema.validate(explained, read_schema("explanation"))
    assert explained["reference_digest"] == found[0]["reference_digest"]


def test_the_command_of_a_result_makes_it_again(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = str(DRONE.parent)
    options = ["--effort", "quick", "--gsd", "0.5:2", "-o", "found", "--plot", "--json", "-q", "-j", "1"]
    main(["locate", f"{folder}/drone.png", f"{folder}/map_sheet.png", "-r", str(porto), *options])
    first = json.loads(capfd.readouterr().out.splitlines()[0])
    program, *command = shlex.split(first["command"])
    assert program == "roadgeo"
    assert main([*command, "--json", "-q"]) == 0
    again = json.loads(capfd.readouterr().out)
    same = {*first} - {"seconds", "command"}
    assert {key: again[key] for key in same} == {key: first[key] for key in same}
    assert shlex.split(again["command"]) == [program, *command]


def test_references_are_described_by_schema(porto: Path, capfd: pytest.CaptureFixture[str]) -> None:
    Path("porto.gpkg").write_bytes(porto.read_bytes())  # without an index: less is known
    for command, schema in (
        (["reference", "info", str(porto), "--json"], "info"),
        (["reference", "info", "porto.gpkg", "--json"], "info"),
        (["reference", "list", "--json"], "info"),
    ):
        assert main(command) == 0
        document = json.loads(capfd.readouterr().out)
        jsonschema.validate(document, read_schema(schema))
        assert document["command"] == shlex.join(["roadgeo", *command])


def test_every_reason_has_a_place_in_the_schema() -> None:
    listed = read_schema("location")["properties"]["reason_code"]["enum"]
    assert listed == [reason.value for reason in Reason]
    assert set(Location("a", "error", "").to_dict()) == set(read_schema("location")["properties"])
