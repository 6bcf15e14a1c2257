"""The queue: who gets which job, what becomes of the jobs of the dead, and what a sweep's directory says."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.cli.sweep import read_shard
from cpdeform.cli.sweep_new import read_numbers
from cpdeform.core.errors import EngineError, InputError
from cpdeform.core.machine import available_cores, machine_cores
from cpdeform.sweep.claim import heartbeat, lose, silent, take
from cpdeform.sweep.job import Job, JobContext
from cpdeform.sweep.plan import combinations
from cpdeform.sweep.queue import ATTEMPTS, CLAIMS, DONE, FAILED, LOST, Queue, SweepHead
from cpdeform.sweep.settle import settle
from cpdeform.sweep.status import sweep_status, throughput, write_sweep_table
from cpdeform.sweep.worker import Worker, WorkSettings, return_lost

HEAD = SweepHead(kind="run")


def make(directory: Path, count: int, **fields: Any) -> Queue:
    jobs = [
        Job(name=f"job-{number:03d}", record=f"records/job-{number:03d}", request={"number": number}) for number in range(count)
    ]
    return Queue.create(directory, SweepHead(kind="run", **fields), jobs)


def square(context: JobContext) -> dict[str, Any]:
    number = context.job.request["number"]
    (context.directory / "square.txt").write_text(str(number**2))
    return {"square": number**2}


def work(queue: Queue, function=square, **settings: Any) -> list[str]:
    return [outcome.name for outcome in Worker(queue, WorkSettings(**settings), function=function).work()]


def age(queue: Queue, name: str, seconds: float) -> None:
    path = queue.file(CLAIMS, name)
    os.utime(path, (path.stat().st_atime, path.stat().st_mtime - seconds))


def test_every_job_is_done_once(tmp_path):
    queue, did = make(tmp_path, 20), []
    workers = [threading.Thread(target=lambda: did.extend(work(queue))) for _ in range(4)]
    for thread in workers:
        thread.start()
    for thread in workers:
        thread.join()
    assert sorted(did) == queue.names() == sorted(queue.listed(DONE))
    assert [(tmp_path / "records" / name / "square.txt").read_text() for name in queue.names()] == [str(n**2) for n in range(20)]
    assert not any(queue.place(CLAIMS).iterdir())
    assert not any(queue.place(ATTEMPTS).iterdir())
    rows, found = write_sweep_table(queue)
    assert [row["square"] for row in rows] == [n**2 for n in range(20)]
    assert found.plans == 20
    assert found.core_hours == pytest.approx(sum(row["seconds"] * row["threads"] for row in rows) / 3600.0)
    assert found.hours_for(400, cores=10) == pytest.approx(2.0 * found.core_hours)
    assert (tmp_path / "table.csv").read_text().startswith("job,number,outcome,square,")


def test_one_claim_a_job(tmp_path):
    queue = make(tmp_path, 1)
    first = take(queue, "job-000", worker="first")
    assert first is not None
    assert take(queue, "job-000", worker="second") is None
    # The same worker in another life, as a task that Ray starts again.
    assert take(queue, "job-000", worker="first") == first
    first.release()
    assert take(queue, "job-000", worker="second") is not None
    first.release()
    assert queue.listed(CLAIMS) == {"job-000"}


def test_the_job_of_a_dead_worker_goes_back(tmp_path):
    queue = make(tmp_path, 3)
    dead, alive = take(queue, "job-000", worker="dead"), take(queue, "job-001", worker="alive")
    assert dead is not None
    assert alive is not None
    age(queue, "job-000", 100.0)
    age(queue, "job-001", 5.0)
    assert silent(queue, after=10.0) == [("job-000", "dead")]
    status = sweep_status(queue, stale_after=10.0)
    assert (status.running, status.silent, status.waiting, status.lost) == (1, 1, 1, 0)
    alive.release()
    assert work(queue, stale_after=10.0) == ["job-000", "job-001", "job-002"]
    assert not dead.held
    assert sweep_status(queue).lost == 1


def test_a_claim_that_is_new_is_not_lost(tmp_path):
    queue = make(tmp_path, 1)
    assert take(queue, "job-000", worker="new") is not None
    assert not lose(queue, "job-000", worker="old")
    assert queue.listed(CLAIMS) == {"job-000"}
    assert not queue.listed(LOST)
    assert lose(queue, "job-000", worker="new")
    assert not lose(queue, "job-000", worker="new")


def test_a_worker_that_was_silent_for_too_long_leaves_the_job(tmp_path):
    """What it made is dropped; the other's stays."""
    queue = make(tmp_path, 1)

    def overtaken(context: JobContext) -> dict[str, Any]:
        lose(queue, "job-000", worker="slow")
        assert work(queue) == ["job-000"]
        return {"square": -1}

    slow = Worker(queue, function=overtaken, identity="slow")
    assert list(slow.work()) == []
    assert [content["square"] for _, content in queue.outcomes()] == [0]
    assert (tmp_path / "records" / "job-000" / "square.txt").read_text() == "0"


def test_a_worker_that_wakes_up_at_the_very_end_leaves_the_job(tmp_path, monkeypatch):
    """It was asleep after it saw that the job was its own; the other, who is not done yet, has its directory."""
    queue, other = make(tmp_path, 1), []

    def sleep(*arguments: Any) -> Any:
        monkeypatch.undo()
        lose(queue, "job-000", worker="slow")
        other.append(take(queue, "job-000", worker="other"))
        other[0].attempt.parent.joinpath("job-000@slow").rename(other[0].attempt)
        return settle(*arguments)

    monkeypatch.setattr("cpdeform.sweep.worker.settle", sleep)
    slow = Worker(queue, function=square, identity="slow")
    claim = take(queue, "job-000", worker="slow")
    assert slow.do(claim) is None
    # Were the job over now, it would have no record if the other died.
    assert not queue.is_over("job-000")
    assert other[0].held
    assert Worker(queue, function=square, identity="other").do(other[0]) is not None
    assert (tmp_path / "records" / "job-000" / "square.txt").read_text() == "0"
    assert [path.name for path in queue.place(DONE).iterdir()] == ["job-000.json"]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_at_the_end_of_a_job(tmp_path, monkeypatch, number):
    """What came of the job stays, and whoever does it next finds it; nothing says that it is over."""
    queue, seen = make(tmp_path, 1), []

    def remember(context: JobContext) -> dict[str, Any]:
        seen.append(sorted(path.name for path in context.directory.iterdir()))
        return square(context)

    def full(file: int) -> None:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr("cpdeform.sweep.queue.os.fsync", full)
        with pytest.raises(EngineError, match=f"job-000 is over, but this cannot be written: {os.strerror(number)}"):
            work(queue, remember)
    assert not queue.is_over("job-000")
    assert not any(path for place in (CLAIMS, DONE, FAILED) for path in queue.place(place).iterdir())
    assert work(queue, remember) == ["job-000"]
    assert seen == [[], ["square.txt"]]


def test_a_job_that_ends_its_process_fails(tmp_path):
    """Where it ended the worker with exit code 0, that would pass for one with nothing left to do."""
    queue = make(tmp_path, 2)

    def leave(context: JobContext) -> dict[str, Any]:
        if context.job.name == "job-000":
            sys.exit(0)
        return square(context)

    assert work(queue, leave) == ["job-000", "job-001"]
    assert {name: content.get("reason") for name, content in queue.outcomes()} == {"job-000": "SystemExit: 0", "job-001": None}


def test_a_worker_that_is_told_to_end_gives_its_job_back(tmp_path):
    """As submitit does before its time is over: its signal's handler ends the process."""
    queue = make(tmp_path, 1)
    worker = Worker(queue, WorkSettings(), function=lambda context: told())

    def told() -> dict[str, Any]:
        worker.ending = True
        sys.exit(144)

    with pytest.raises(SystemExit):
        next(worker.work())
    status = sweep_status(queue)
    assert (status.waiting, status.failed, status.running) == (1, 0, 0)
    assert work(queue) == ["job-000"]


def test_a_job_that_takes_its_directory_away_is_done(tmp_path):
    queue = make(tmp_path, 1)
    assert work(queue, lambda context: context.directory.rmdir() or {}) == ["job-000"]
    assert sweep_status(queue).done == 1


def test_a_heartbeat_that_is_only_seen_when_the_file_is_opened(tmp_path, monkeypatch):
    """As with NFS, whose clients may answer from memory until then."""
    queue, stat = make(tmp_path, 1), Path.stat
    assert take(queue, "job-000", worker="far") is not None

    def remembered(path: Path, **options: Any) -> os.stat_result:
        found = stat(path, **options)
        return os.stat_result([*found[:8], found.st_mtime - 100.0, found.st_ctime]) if path.name == "job-000.json" else found

    monkeypatch.setattr(Path, "stat", remembered)
    assert silent(queue, after=60.0) == []


def test_only_the_first_signal_interrupts():
    """Control-C reaches a worker twice: from the terminal, and from the command that watches it."""
    script = (
        "import os, signal\n"
        "from cpdeform.sweep.engines.local import interrupt_once\n"
        "interrupt_once()\n"
        "try:\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "except KeyboardInterrupt:\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    print('given back')\n"
    )
    finished = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert finished.stdout == "given back\n"


def test_heartbeats(tmp_path):
    queue = make(tmp_path, 1)
    claim = take(queue, "job-000", worker="w")
    assert claim is not None
    age(queue, "job-000", 100.0)
    with heartbeat(claim, stale_after=0.05):
        limit = time.monotonic() + 30.0
        while silent(queue, after=50.0) and time.monotonic() < limit:
            time.sleep(0.01)
        assert not silent(queue, after=50.0)


def test_a_job_that_workers_die_on_fails(tmp_path):
    queue = make(tmp_path, 2)
    for number in range(3):
        assert not queue.listed(FAILED)
        assert take(queue, "job-000", worker=f"w{number}") is not None
        age(queue, "job-000", 100.0)
        return_lost(queue, WorkSettings(stale_after=10.0, attempts=3))
    ((name, content),) = queue.outcomes()
    assert (name, content["reason"]) == ("job-000", "3 workers died on it (out of memory, or killed)")
    assert work(queue) == ["job-001"]


def test_failures_and_what_comes_after(tmp_path):
    jobs = [
        Job(name="a", record="records/a", request={"number": 1}, after="b"),
        Job(name="b", record="records/b", request={"number": 2}),
        Job(name="c", record="records/c"),
    ]
    queue = Queue.create(tmp_path, HEAD, jobs)
    assert work(queue) == ["b", "c", "a"]
    reasons = {name: content["reason"] for name, content in queue.outcomes(queue.listed(FAILED))}
    assert reasons == {"c": "KeyError: 'number'"}
    retried = CliRunner().invoke(app, ["sweep", "retry", str(tmp_path)])
    assert retried.output == "1 jobs are in the queue again\n"
    assert work(queue, lambda context: {}) == ["c"]
    assert not (tmp_path / "records" / "c").exists()


def test_a_damaged_job_fails(tmp_path):
    queue = make(tmp_path, 1)
    queue.file("jobs", "job-000").write_text("{")
    assert work(queue) == ["job-000"]
    ((_, content),) = queue.outcomes()
    assert "job-000" in content["reason"]


def test_an_attempt_goes_on_from_what_an_earlier_one_left(tmp_path):
    queue = make(tmp_path, 1)
    seen = []

    def interrupted(context: JobContext) -> dict[str, Any]:
        seen.append(sorted(path.name for path in context.directory.iterdir()))
        (context.directory / f"part-{len(seen)}").touch()
        if len(seen) < 3:
            raise KeyboardInterrupt
        return {}

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            work(queue, interrupted)
        assert not queue.listed(CLAIMS)
    assert work(queue, interrupted) == ["job-000"]
    assert seen == [[], ["part-1"], ["part-1", "part-2"]]
    assert len(list((tmp_path / "records" / "job-000").iterdir())) == 3
    assert sweep_status(queue).lost == 0


def test_a_new_record_takes_the_place_of_an_old_one(tmp_path):
    """What is no record's stays."""
    queue, place = make(tmp_path, 1), tmp_path / "records" / "job-000"
    place.mkdir(parents=True)
    for name in ("run.json", "stage-000.h5", "notes.txt"):
        (place / name).touch()
    work(queue)
    assert sorted(path.name for path in place.iterdir()) == ["notes.txt", "square.txt"]


def test_shards_are_parts(tmp_path):
    queue = make(tmp_path, 7)
    parts = [work(queue, shard=(number, 3)) for number in range(3)]
    assert [len(part) for part in parts] == [3, 2, 2]
    assert sorted(name for part in parts for name in part) == queue.names()
    assert sweep_status(queue).over


def test_the_same_sweep_again(tmp_path):
    queue = make(tmp_path, 3)
    (tmp_path / "sweep.json").unlink()
    with pytest.raises(InputError, match=r"no sweep\.json"):
        Queue(tmp_path)
    work(make(tmp_path, 3))
    assert len(make(tmp_path, 3).listed(DONE)) == 3
    other = Job(name="job-001", record="records/job-001", request={"number": 7})
    with pytest.raises(InputError, match="another job job-001"):
        Queue.create(tmp_path, HEAD, [other])
    with pytest.raises(InputError, match="kind run with None threads"):
        make(tmp_path, 3, threads=2)
    assert Queue.create(tmp_path, HEAD, [other], replace=True).job("job-001").request == {"number": 7}
    assert queue.names() == ["job-000", "job-001", "job-002"]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"name": "a/b"}, "letters, digits"),
        ({"name": ".."}, "letters, digits"),
        ({"record": "../elsewhere"}, "within the sweep's directory"),
        ({"record": "/etc"}, "within the sweep's directory"),
        ({"after": "*"}, "letters, digits"),
    ],
)
def test_jobs_stay_in_their_directory(fields, message):
    with pytest.raises(InputError, match=message):
        Job(**{"name": "a", "record": "records/a", **fields})


def test_numbers():
    assert read_numbers("0:3,7", "--seeds") == (0, 1, 2, 7)
    assert read_shard("3/8") == (3, 8)
    for text in ("3:1", "a", "1:2:3", "", "-1", "0:10000000"):
        with pytest.raises(InputError, match="--seeds"):
            read_numbers(text, "--seeds")
    for text in ("4/4", "1", "-1/2", "a/b"):
        with pytest.raises(InputError, match="--shard"):
            WorkSettings(shard=read_shard(text))
    assert combinations([("a.b", [1, 2]), ("a.c", [3]), ("d", ["x", "y"])]) == (
        {"a": {"b": 1, "c": 3}, "d": "x"},
        {"a": {"b": 1, "c": 3}, "d": "y"},
        {"a": {"b": 2, "c": 3}, "d": "x"},
        {"a": {"b": 2, "c": 3}, "d": "y"},
    )


def test_threads_are_those_of_the_environment(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1,4")
    assert available_cores() == 1
    for text in ("", "0", "many", "100000"):
        monkeypatch.setenv("OMP_NUM_THREADS", text)
        assert available_cores() == machine_cores()


def test_throughput_of_nothing():
    assert throughput([]).plans_per_core_hour is None


def test_commands(tmp_path, monkeypatch, toy_distribution, toy_task_file):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(toy_distribution))
    parts = ["--backend", "toy", "--ot", "toy", "--iterations", "2", "--stages", "1"]

    def invoke(*arguments):
        return CliRunner().invoke(app, ["sweep", *arguments])

    wanted = ["new", "s", "--tasks", "shift.yaml", "--seeds", "0:2", *parts, "--vary", "placer=toy,toy-fixed,fixed"]
    made = invoke(*wanted)
    assert made.exit_code == 0, made.output
    assert "s: 6 jobs" in made.output
    assert invoke(*wanted).exit_code == 0
    queue = Queue(tmp_path / "s")
    assert [outcome.outcome for outcome in Worker(queue).work()] == ["done"] * 6
    found = invoke("status", "s", "--json")
    assert json.loads(found.stdout)["over"]
    table = invoke("table", "s")
    assert "6 of 6 jobs done\n6 plans in " in table.output
    rows = json.loads(invoke("table", "s", "--json").stdout)["rows"]
    assert [(row["placer"], row["seed"], row["status"], row["stages"]) for row in rows] == [
        (placer, seed, "finished", 1) for placer in ("toy", "toy-fixed", "fixed") for seed in (0, 1)
    ]
    for arguments, message in (
        (["status", "nowhere"], "no sweep.json"),
        (["work", "s", "--shard", "2/2"], "--shard: got 2/2"),
        (["work", "s", "--engine", "lokal"], 'Did you mean "local"'),
        (["work", "s", "--workers", "0"], "--workers: got 0"),
        (["work", "s", "--set", "gpus=1"], "option of engine local"),
        (["new", "t", "--tasks", "shift.yaml", "--vary", "placer=tyo"], 'Did you mean "toy"'),
        (["new", "t", "--tasks", "shift.yaml", "--set", "seed=3"], "Use --seeds instead"),
        (["new", "s", "--tasks", "shift.yaml", *parts], "another job"),
    ):
        refused = invoke(*arguments)
        assert (refused.exit_code, message in refused.stderr) == (2, True), refused.stderr
    assert not (tmp_path / "t").exists()


def test_status_imports_nothing_heavy(tmp_path):
    make(tmp_path, 1)
    script = (
        "import sys\n"
        "from cpdeform.cli.main import app\n"
        f"app(['sweep', 'status', {str(tmp_path)!r}], standalone_mode=False)\n"
        "print('HEAVY', sorted({'torch', 'warp', 'h5py', 'scipy', 'yaml', 'ray', 'submitit'} & set(sys.modules)))\n"
    )
    finished = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert finished.stdout.splitlines() == ["0 of 1 jobs done, 1 waiting", "HEAVY []"]
