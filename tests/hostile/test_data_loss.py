"""No output replaces a record, another program's file or half of itself; Ctrl-C and kill keep what was done."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command import motorid

import motorid as mi
from motorid.acquire.protocol import Channel, Header
from motorid.acquire.session import Recording
from motorid.errors import OutputError, UsageError
from motorid.records.datasets import data_path
from motorid.records.files import write_files
from motorid.uncertainty.batch import Checkpoint

RUN = data_path("two_step") / "step_6V.csv"
SMALL = ("--fix", "L=0")


@pytest.fixture
def run(tmp_path) -> Path:
    path = tmp_path / "run1.csv"
    path.write_bytes(RUN.read_bytes())
    return path


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("saved") / "fit.json"
    assert motorid("fit", RUN, "--json", path).status == 0
    return path


@pytest.mark.parametrize("words", [
    ("fit", "{run}", "--json", "{run}"), ("fit", "{run}", "--report", "{run}"), ("fit", "{run}", "--json", "{link}"),
    ("diagnose", "{run}", "--json", "{run}"), ("diagnose", "{run}", "--remainder-to", "{run}"),
    ("fit-many", "{folder}", "--out", "{run}"), ("fit-many", "{folder}", "--journal", "{run}"),
    ("export", "{saved}", "{run}", "--to", "c"), ("export", "{saved}", "{run}", "--to", "json"),
    ("export", "{saved}", "{saved}"), ("simulate", "{saved}", "{run}", "--json", "{saved}"),
    ("identifiability", "{run}", "--json", "{run}"), ("robustness", "{run}", "--json", "{run}"),
], ids=" ".join)
def test_an_output_is_never_written_over_an_input(words, run, saved, tmp_path):
    link = tmp_path / "link.json"
    link.symlink_to(run)
    before = run.read_bytes(), saved.read_bytes()
    done = motorid(*(w.format(run=run, folder=tmp_path, saved=saved, link=link) for w in words))
    assert done.status == 2, done
    assert "cannot write" in done.err or "not a journal" in done.err
    assert (run.read_bytes(), saved.read_bytes()) == before


def test_a_table_is_not_written_over_a_record_that_motorid_wrote(saved, run, tmp_path):
    assert motorid("simulate", saved, run, "--out", tmp_path / "motors").status == 0
    (record,) = (tmp_path / "motors").iterdir()
    before = record.read_bytes()
    done = motorid("fit-many", tmp_path / "motors", *SMALL, "--out", record)
    assert done.status == 2
    assert "it is read as well" in done.err
    assert record.read_bytes() == before


def test_an_output_is_written_over_ours_and_with_force_over_all(run, tmp_path):
    out = tmp_path / "fit.json"
    for _ in range(2):
        assert motorid("fit", run, *SMALL, "--json", out, "--report", tmp_path / "fit.html").status == 0
    out.write_text("my notes", encoding="utf-8")
    assert motorid("fit", run, *SMALL, "--json", out).status == 2
    assert out.read_text(encoding="utf-8") == "my notes"
    assert motorid("fit", run, *SMALL, "--json", out, "--force").status == 0
    assert json.loads(out.read_text(encoding="utf-8"))["motorid"]


def test_every_output_can_be_renewed(saved, run, tmp_path):
    """What motorid writes says that motorid wrote it."""
    folder = tmp_path / "motors"
    folder.mkdir()
    (folder / "a.csv").write_bytes(RUN.read_bytes())
    for _ in range(2):
        for name in ("m.c", "m.json", "m.casadi"):
            assert motorid("export", saved, tmp_path / name).status == 0
        assert motorid("simulate", saved, run, "--out", tmp_path / "sim").status == 0
        for name in ("t.csv", "t.json", "t.parquet"):
            done = motorid("fit-many", folder, *SMALL, "--out", tmp_path / name)
            assert done.status == 0, done.err


def test_export_of_c_leaves_all_alone_where_one_file_is_somebody_elses(saved, tmp_path):
    (tmp_path / "motor.h").write_text("/* mine */", encoding="utf-8")
    done = motorid("export", saved, tmp_path / "motor.c")
    assert done.status == 2
    assert "motor.h" in done.err
    assert [p.name for p in tmp_path.iterdir()] == ["motor.h"]


@pytest.mark.parametrize("name", ["m.casadi", "m.json", "m.c"])
def test_a_full_disk_is_a_sentence_status_1_and_the_old_file(saved, tmp_path, monkeypatch, name):
    path = tmp_path / name
    assert motorid("export", saved, path).status == 0
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    done = motorid("export", saved, path)
    assert (done.status, done.out) == (1, "")
    assert "No space left" in done.err
    assert path.read_bytes() == before
    assert not list(tmp_path.glob(".*"))
    with pytest.raises(OutputError, match="No space"):
        write_files({tmp_path / "x": "text"})


@pytest.mark.parametrize(("words", "shown"), [
    (("fit", "{run}", "--fix", "L=0"), "±"), (("identifiability", "{run}"), "full rank"),
    (("diagnose", "{run}", "--budget", "0"), "below a millionth"), (("fit-many", "{folder}"), "of 1 motors fitted")])
def test_a_result_that_cannot_be_written_is_shown(words, shown, run, tmp_path, monkeypatch):
    """It may have taken hours."""
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    given = (w.format(run=run, folder=run.parent) for w in words)
    done = motorid(*given, "--json", tmp_path / "out.json")
    assert (done.status, "No space left" in done.err) == (1, True)
    assert shown in done.out


def test_a_folder_that_cannot_be_written_to_is_said_before_the_work(run, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr("motorid.cli.fit.evaluate", None)
    monkeypatch.setattr("motorid.cli.options.fit", None)
    done = motorid("fit", run, "--json", tmp_path / "out.json")
    assert (done.status, done.out) == (2, "")
    assert "cannot write" in done.err
    assert motorid("export", run, "/dev/null").status == 2  # a device is no folder


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_device_that_refuses_is_said(run):
    done = motorid("fit", run, *SMALL, "--json", "/dev/full")
    assert done.status == 1
    assert "No space left" in done.err


def test_two_runs_of_one_name_are_simulated_into_two_files(saved, tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder / "x").mkdir(parents=True)
        (tmp_path / folder / "x" / "run.csv").write_bytes(RUN.read_bytes())
    done = motorid("simulate", saved, tmp_path / "a/x/run.csv", tmp_path / "b/x/run.csv", "--out", tmp_path / "out")
    assert done.status == 0, done.err
    assert len(list((tmp_path / "out").iterdir())) == 2


@pytest.mark.parametrize("option", ["--json", "--report"])
def test_an_output_without_a_name_is_none_that_was_asked_for(run, option):
    """A variable of the shell that was never set."""
    done = motorid("fit", run, option, "")
    assert (done.status, done.out) == (2, "")


def test_two_results_cannot_be_one_file(run, tmp_path):
    done = motorid("fit", run, "--json", tmp_path / "x", "--report", tmp_path / "x")
    assert done.status == 2
    assert not (tmp_path / "x").exists()


def test_a_journal_that_is_none_is_left_alone_and_a_damaged_one_goes_on(tmp_path):
    path = tmp_path / "batch.jsonl"
    path.write_text("t,v\n1,2\n", encoding="utf-8")
    with pytest.raises(UsageError, match="not a journal"):
        Checkpoint(path)
    entry = json.dumps({"fingerprint": "a", "row": {"motor": "m"}})
    path.write_bytes(b"\xff\xfe\n" + entry.encode() + b'\n{"fingerprint": "b", "ro')
    again = Checkpoint(path)
    again.add("c", {"motor": "n"})
    assert list(Checkpoint(path).rows) == ["a", "c"]
    with pytest.raises(UsageError, match="cannot write"):
        Checkpoint(path / "below")


def start(*words: object, **options: object) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-m", "motorid", *map(str, words)], stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True, **options)  # type: ignore[call-overload]  # env and the like


@pytest.mark.parametrize("after", [0.4, 2.5])
def test_ctrl_c_is_status_130_in_the_first_second_and_later(after):
    process = start("robustness", RUN, "--starts", 5000)
    time.sleep(after)
    process.send_signal(signal.SIGINT)
    for _ in range(6):  # while Python itself is starting it may lose one: then it is pressed again, as anybody would,
        try:  # but not while the command is about to end: Python itself may die of it there
            out, err = process.communicate(timeout=5)
            break
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
    assert process.returncode == 130
    assert "interrupted" in err.lower()
    assert "Traceback" not in out + err


@pytest.mark.skipif(sys.platform == "win32", reason="no polite kill there")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_polite_kill_keeps_what_was_done_as_ctrl_c_does(tmp_path, name):
    journal, table = tmp_path / "batch.jsonl", tmp_path / "table.csv"
    before = signal.signal(getattr(signal, name), signal.SIG_DFL)  # under nohup a hang-up is ignored, and inherited
    process = start("fit-many", motors(tmp_path / "motors", 40), "--journal", journal, "--out", table)
    signal.signal(getattr(signal, name), before)
    begun(process, journal)
    process.send_signal(getattr(signal, name))
    _, err = process.communicate(timeout=30)
    assert (process.returncode, "interrupted" in err) == (130, True), err
    assert 3 <= len(table.read_text().splitlines()) < 41


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals there")
def test_ctrl_c_after_the_work_does_not_make_it_a_failure(tmp_path):
    """While Python ends it hears no signals, and would die of one; a command that is kept running by nohup goes on."""
    code = ("import os, signal; signal.signal(signal.SIGHUP, signal.SIG_IGN); "
            "from motorid.numerics.parallel import interruption as it; it.listen(); "
            "os.kill(os.getpid(), signal.SIGHUP); it.over(); "
            "[os.kill(os.getpid(), n) for n in (signal.SIGINT, signal.SIGALRM, signal.SIGTERM)]")
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def motors(folder: Path, count: int) -> Path:
    folder.mkdir()
    base, rng = mi.read_csv(RUN), np.random.default_rng(3)
    for k in range(count):
        noise = {c: y + rng.normal(0, 0.01 * np.ptp(y), y.shape) for c, y in base.outputs.items()}
        mi.records.reading.write_csv(base.with_(outputs=noise), folder / f"m{k:02}.csv")
    return folder


def begun(process: subprocess.Popen[str], journal: Path, lines: int = 3) -> None:
    """Wait until a batch has so many results."""
    while process.poll() is None and not (journal.exists() and journal.read_bytes().count(b"\n") >= lines):
        time.sleep(0.002)


def without_seconds(table: Path) -> list[list[str]]:
    rows = [line.split(",") for line in table.read_text().splitlines()]
    seconds = rows[0].index("seconds")
    return [[c for k, c in enumerate(r) if k != seconds] for r in rows]


@pytest.mark.skipif(sys.platform == "win32", reason="no such kill there")
def test_no_worker_outlives_a_command_that_was_killed(tmp_path):
    journal = tmp_path / "batch.jsonl"
    process = start("fit-many", motors(tmp_path / "motors", 60), "--journal", journal, "--jobs", 2)
    begun(process, journal, 1)
    process.kill()
    process.communicate(timeout=20)  # its pipes close when the last one that has them has gone


def test_two_batches_on_one_journal_end_in_the_same_table(tmp_path):
    folder, tables = motors(tmp_path / "motors", 4), [tmp_path / f"{k}.csv" for k in range(3)]
    both = [start("fit-many", folder, "--journal", tmp_path / "batch.jsonl", "--out", t) for t in tables[:2]]
    for process in both:
        _, err = process.communicate(timeout=60)
        assert process.returncode == 0, err
    assert motorid("fit-many", folder, "--journal", tmp_path / "batch.jsonl", "--out", tables[2]).status == 0
    assert without_seconds(tables[0]) == without_seconds(tables[1]) == without_seconds(tables[2])
    lines = (tmp_path / "batch.jsonl").read_text(encoding="utf-8").splitlines()
    assert {json.loads(line)["row"]["motor"] for line in lines} == {f"m{k:02}" for k in range(4)}


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no pseudo-terminals there")
def test_the_name_of_a_virtual_port_takes_the_place_of_no_file(tmp_path, run):
    (tmp_path / "link").symlink_to(run)
    for name, says in ((run, "no link to a port"), (tmp_path / "link", "no link to a port"),
                       (tmp_path / "none" / "port", "No such file")):
        done = motorid("bench", "--link", name, "--once")
        assert done.status == 2
        assert says in done.err
    assert run.read_bytes() == RUN.read_bytes()
    assert (tmp_path / "link").is_symlink()


@pytest.mark.parametrize("name", ["motorid_mine.py", "bench.py"])
def test_a_script_that_imports_the_package_keeps_its_own_ctrl_c(tmp_path, name):
    script = tmp_path / name
    script.write_text("import sys, motorid\nprint(sys.excepthook is sys.__excepthook__)\n")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "True", done.stderr


def test_an_interrupted_diagnosis_keeps_its_fit(run, tmp_path, monkeypatch):
    from motorid.cli import diagnose

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(diagnose, "diagnose", stop)
    done = motorid("diagnose", run, "--json", tmp_path / "found.json")
    assert done.status == 130
    assert "interrupted" in done.err
    assert json.loads((tmp_path / "found.json").read_text())["parameters"]["R"]["value"] > 0


def test_a_recording_without_a_sample_is_no_success(tmp_path):
    header = Header("d", 100.0, (Channel("v", "V"), Channel("i", "A")))
    for received in (0, 5):
        done = Recording(tmp_path / "x.csv", header, "done", "", received, 0, True, 0.0, {}, {})
        assert done.complete == (received > 0)
        assert ("Nothing was recorded" in str(done)) == (received == 0)


def test_a_batch_killed_in_the_middle_of_its_journal_ends_in_the_same_table(tmp_path):
    folder, journal = motors(tmp_path / "motors", 40), tmp_path / "batch.jsonl"
    process = start("fit-many", folder, "--journal", journal)
    begun(process, journal, 5)
    process.kill()
    process.communicate()
    done = journal.read_bytes().count(b"\n")
    assert 5 <= done < 40, "it must be killed in the middle"
    with journal.open("r+b") as file:  # as if it had died within a line
        file.truncate(journal.stat().st_size - 20)
    tables = [tmp_path / "resumed.csv", tmp_path / "whole.csv"]
    assert motorid("fit-many", folder, "--journal", journal, "--out", tables[0]).status == 0
    assert journal.read_bytes().count(b"\n") == done + 40 - (done - 1), "what was done before was done again"
    assert motorid("fit-many", folder, "--out", tables[1]).status == 0
    assert without_seconds(tables[0]) == without_seconds(tables[1])


def test_a_file_that_only_speaks_of_motorid_is_not_ours(tmp_path):
    notes = tmp_path / "notes.json"
    notes.write_text('{"motorid": "what I think of it"}', encoding="utf-8")
    assert motorid("fit", RUN, "--json", notes).status == 2
    assert "think" in notes.read_text(encoding="utf-8")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with a name there")
def test_a_pipe_that_nobody_reads_does_not_hold_the_command_up(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OutputError):
        write_files({tmp_path / "pipe": "x"})


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no such device there")
def test_a_full_disk_behind_the_terminal_is_one_sentence():
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-m", "motorid", "effects", "coulomb"], stdout=full,
                              stderr=subprocess.PIPE, text=True, timeout=60)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1), done.stderr


def test_a_motor_that_was_renamed_has_its_new_name(tmp_path):
    """The journal knows records by what is in them."""
    folder, out = tmp_path / "motors", tmp_path / "table.csv"
    folder.mkdir()
    (folder / "a.csv").write_bytes(Path(RUN).read_bytes())
    words = ("fit-many", folder, *SMALL, "--journal", tmp_path / "j.jsonl", "--out", out)
    assert motorid(*words).status == 0
    (folder / "a.csv").rename(folder / "z.csv")
    (folder / "y.csv").write_bytes(Path(RUN).read_bytes())
    assert motorid(*words).status == 0
    assert [row[0] for row in without_seconds(out)] == ["motor", "y", "z"]


def test_a_spoilt_row_of_a_journal_is_done_again(tmp_path):
    (tmp_path / "motors").mkdir()
    (tmp_path / "motors" / "a.csv").write_bytes(Path(RUN).read_bytes())
    journal, words = tmp_path / "j.jsonl", ("fit-many", tmp_path / "motors", "--journal", tmp_path / "j.jsonl")
    assert motorid(*words).status == 0
    journal.write_text(re.sub(r'"R": [\d.e-]+', '"R": "x"', journal.read_text(encoding="utf-8")), encoding="utf-8")
    done = motorid(*words)
    assert done.status == 0, done.err
    assert len(journal.read_text(encoding="utf-8").splitlines()) == 2


def test_a_result_is_written_though_nobody_reads_what_is_printed(tmp_path):
    out = tmp_path / "fit.json"
    command = [sys.executable, "-m", "motorid", "fit", str(RUN), "--json", str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()  # as `| head` does
        said = process.stderr.read()
    assert process.returncode == 0, said
    assert "Traceback" not in said
    assert json.loads(out.read_text(encoding="utf-8"))["parameters"]
