"""`motorid diagnose --remainder-to FILE.py`: what no effect explains, as an effect for the next fit."""

from __future__ import annotations

import pytest
from command import motorid, motorid_json

from motorid.records.datasets import data_path

RUNS = sorted(str(p) for p in data_path("hidden_friction").glob("run*.csv"))


@pytest.mark.parametrize(("file", "name"), [("left.py", "left"), ("my-law.py", "remainder")])
def test_what_is_left_is_written_and_fitted_again(tmp_path, file, name):
    file = tmp_path / file
    done = motorid("diagnose", *RUNS, "--max-effects", 0, "--remainder-to", file)
    assert done.status == 0
    assert f"--effects {name}" in done.out
    plain = motorid_json(tmp_path, "fit", *RUNS)
    curved = motorid_json(tmp_path, "fit", *RUNS, "--effects-from", file, "--effects", name)
    assert curved["nrmse"]["omega"] < 0.3 * plain["nrmse"]["omega"]


def test_a_file_that_is_there_is_not_written_over(tmp_path):
    file = tmp_path / "left.py"
    file.write_text("mine", encoding="utf-8")
    done = motorid("diagnose", *RUNS, "--max-effects", 0, "--remainder-to", file)
    assert done.status == 2
    assert "did not write it" in done.err
    assert file.read_text(encoding="utf-8") == "mine"


def test_the_report_is_written_although_no_curve_is_left(tmp_path):
    """All is explained: there is nothing to write down, and no reason to lose the rest."""
    report, file = tmp_path / "found.html", tmp_path / "left.py"
    done = motorid("diagnose", *RUNS, "--max-effects", 1, "--remainder-to", file, "--report", report)
    assert done.status == 2
    assert "nothing is left" in done.err
    assert report.exists()
    assert not file.exists()
