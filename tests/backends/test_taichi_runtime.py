"""The one Taichi runtime of a process: who starts it, what it serves, what is refused, and worker processes."""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest
import torch
from backend_cases import CASES, backend_class, positions_and_gradient

from cpdeform.core.errors import CpdeformError

pytest.importorskip("cpdeform.backends.taichi.runtime", reason="Taichi is not installed", exc_type=ModuleNotFoundError)

START = "from cpdeform.backends.taichi.simulator import SimulatorTaichi; from backend_cases import CASES; scene = CASES['sphere']\n"


def run(code: str) -> str:
    """Run code in a fresh process; returns what it printed."""
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_neither_the_package_nor_the_command_line_imports_taichi() -> None:
    """But `cpdeform plugins` does, to tell whether the part can be used; that does not start it."""
    code = """
        import sys, cpdeform, cpdeform.cli.main
        from typer.testing import CliRunner
        assert CliRunner().invoke(cpdeform.cli.main.app, ["--help"]).exit_code == 0
        assert "taichi" not in sys.modules
        assert "\\n  taichi " in CliRunner().invoke(cpdeform.cli.main.app, ["plugins"]).output
        import taichi as ti
        assert ti.cfg is None
    """
    assert run("if True:" + code) == ""


def test_the_first_simulator_starts_it_without_a_word_and_others_share_it() -> None:
    code = """
        import os
        before = dict(os.environ)
        from cpdeform.backends.taichi.simulator import SimulatorTaichi
        import taichi as ti
        assert ti.cfg is None
        first = SimulatorTaichi(scene, threads=2)
        program = ti.lang.impl.get_runtime().prog
        assert (first.threads, SimulatorTaichi(scene, threads=1).threads) == (2, 1)
        assert ti.lang.impl.get_runtime().prog is program
        assert dict(os.environ) == before
    """
    assert run("from backend_cases import CASES; scene = CASES['sphere']\nif True:" + code) == ""


def test_another_device_is_refused() -> None:
    from cpdeform.backends.taichi.runtime import require

    backend_class("taichi")
    with pytest.raises(CpdeformError, match=r"runs a runtime on .* with \d+ threads?; asked for was the device cuda\..*spawn"):
        require(torch.device("cuda"))


def test_more_threads_are_refused() -> None:
    with pytest.raises(CpdeformError, match=r"asked for was one with 1000 threads\..*ProcessPoolExecutor"):
        backend_class("taichi")(CASES["sphere"], threads=1000)


@pytest.mark.slow
def test_one_that_the_program_started_is_used_and_not_replaced(tmp_path: Path) -> None:
    """With fast math and other default types, which change last digits but no more."""
    code = """
        import taichi as ti, torch
        ti.init(arch=ti.cpu, cpu_max_num_threads=1, default_fp=ti.f64, fast_math=True, advanced_optimization=False,
                cfg_optimization=False, log_level=ti.ERROR)
        field = ti.field(ti.f32, shape=1)
        field[0] = 3.0
        from backend_cases import positions_and_gradient
        positions, gradient = positions_and_gradient("taichi", "sphere", "cpu", dtype=torch.float32)
        assert field[0] == 3.0
        assert SimulatorTaichi(scene).threads == 1
        try:
            SimulatorTaichi(scene, threads=2)
        except RuntimeError as error:
            assert "with 1 thread;" in str(error)
        else:
            raise AssertionError("two threads")
        torch.save((positions, gradient), OUT)
    """
    path = tmp_path / "result.pt"
    run(START + f"OUT = {str(path)!r}\nif True:" + code)
    positions, gradient = torch.load(path)
    backend_class("taichi")
    expected_positions, expected_gradient = positions_and_gradient("taichi", "sphere", "cpu", dtype=torch.float32)
    assert torch.allclose(positions, expected_positions, atol=1e-6)
    assert torch.nn.functional.cosine_similarity(gradient.flatten(), expected_gradient.flatten(), dim=0) > 0.9999


@pytest.mark.slow
def test_simulators_survive_that_the_program_starts_it_anew() -> None:
    code = """
        import taichi as ti, torch
        simulator = SimulatorTaichi(scene, threads=1)
        first = simulator.rollout(simulator.initial_state(), torch.ones(1, 1, 3)).positions
        ti.init(arch=ti.cpu, log_level=ti.ERROR, fast_math=False, advanced_optimization=False, cfg_optimization=False)
        assert torch.equal(simulator.rollout(simulator.initial_state(), torch.ones(1, 1, 3)).positions, first)
    """
    run(START + "if True:" + code)


def test_a_forked_child_is_refused() -> None:
    code = """
        import os, torch
        simulator = SimulatorTaichi(scene)
        child = os.fork()
        if child == 0:
            caught = 0
            for use in (lambda: SimulatorTaichi(scene), lambda: simulator.rollout(simulator.initial_state(), torch.zeros(1, 1, 3))):
                try:
                    use()
                except RuntimeError as error:
                    caught += "forked" in str(error) and "spawn" in str(error)
            os._exit(caught)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    """
    assert run(START + "if True:" + code) == "2\n"


@pytest.mark.slow
def test_a_spawned_worker_has_a_runtime_of_its_own() -> None:
    backend_class("taichi")
    positions, gradient = positions_and_gradient("taichi", "two tools", "cpu", threads=1)
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as workers:
        future = workers.submit(positions_and_gradient, "taichi", "two tools", "cpu", threads=5)
        other_positions, other_gradient = future.result()
    assert torch.allclose(positions, other_positions, atol=1e-12)
    assert torch.allclose(gradient, other_gradient, rtol=1e-7, atol=1e-12)
