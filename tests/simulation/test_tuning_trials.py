"""The comparison of tunings keeps who has walked, and takes nobody for another tuning's."""

import json
from dataclasses import replace
from pathlib import Path

from benchmarks.loop.tuning import Kept, Result


def test_who_has_walked_is_kept_and_found_again(tmp_path: Path) -> None:
    file = tmp_path / "people.jsonl"
    walked = {"short": Result([True, False, True]), "tuner": replace(Result([False]), latched="why", named="slip")}
    Kept(file).add(True, 7, {"day": walked})
    again = Kept(file)
    assert {arm: again.results[True, 7, "day", arm] for arm in walked} == walked
    assert again.has(True, 7, "day", ["tuner", "short"])
    assert again.left(True, 7, ["day", "slip"], ["short"]) == (["slip"], ["short"])
    assert again.left(True, 7, ["day"], ["short", "plain"]) == (["day"], ["plain"])
    assert again.left(True, 7, ["day"], ["short", "tuner"]) == ([], [])
    for other in ((False, 7, "day", ["short"]), (True, 8, "day", ["short"]), (True, 7, "day", ["short", "plain"])):
        assert not again.has(*other)


def test_a_result_of_another_tuning_counts_as_none(tmp_path: Path) -> None:
    file = tmp_path / "people.jsonl"
    Kept(file).add(False, 7, {"day": {"short": Result([True])}})
    row = json.loads(file.read_text(encoding="utf-8"))
    file.write_text(json.dumps(row | {"tuning": "another"}) + "\n", encoding="utf-8")
    assert not Kept(file).results
