from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from cpdeform_toy.parts import OTSolverExactToy, OTSolverToy, PlacerFixedToy, PlacerToy
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.core.errors import CapabilityError, InputError, UnknownNameError
from cpdeform.core.objective import Objective, ObjectiveResult
from cpdeform.core.ot import TransportProblem
from cpdeform.core.placer import LEAST_GAIN
from cpdeform.core.plugins import load_registry
from cpdeform.core.task import load_task
from cpdeform.planning.algorithm import Planner
from cpdeform.planning.objectives.transport import ObjectiveTransport
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.descent import PhaseDescent
from cpdeform.planning.pruner import PrunerHalving, PrunerNone
from cpdeform.planning.result import Observer, Status
from cpdeform.planning.stage_parts import failed_contacts
from cpdeform.planning.still import still_trajectory
from cpdeform.run.configuration import PrioritiesConfiguration, RunConfiguration
from cpdeform.run.deform import deform
from cpdeform.run.resolve import resolve


class Diary(Observer):
    def __init__(self):
        self.entries = []

    def run_started(self, task, goal, names, seed):
        self.entries.append("start")

    def iteration_finished(self, stage, iteration):
        self.entries.append(f"iteration {stage}")

    def stage_finished(self, result):
        self.entries.append(f"stage {result.index}")

    def run_finished(self, result):
        self.entries.append("end")


@pytest.fixture
def task(toy_task_file):
    return load_task(toy_task_file)


def planner(task, *, batch_size=4, simulator=None, solver=None, placer=None, iterations=10, noise=0.01, pruner=None, **options):
    simulator = simulator or SimulatorToy(task.scene, batch_size=batch_size)
    solver = solver or OTSolverToy()
    optimizer = TrajectoryOptimizer(iterations=iterations, initial_noise=noise, pruner=pruner or PrunerHalving())
    return Planner(
        task=task,
        simulator=simulator,
        ot_solver=solver,
        placer=placer or PlacerToy(),
        objective=ObjectiveTransport(OTSolverToy(), torch.as_tensor(task.load_goal()), scene=task.scene),
        phases=(PhaseDescent(optimizer=optimizer),),
        **options,
    )


def test_stages_follow_each_other_and_the_best_plan_is_executed(task):
    diary, placer = Diary(), PlacerToy()
    made = planner(task, placer=placer, iterations=3, observers=(diary,))
    result = made.run()
    assert diary.entries == ["start", *["iteration 0"] * 3, "stage 0", *["iteration 1"] * 3, "stage 1", "end"]
    assert result.status is Status.FINISHED
    first, second = result.stages
    assert torch.equal(second.state_before.position, first.state.position)
    assert result.state is second.state
    assert first.loss_before == result.loss_initial > first.loss > second.loss == result.loss_final
    # The nearest of the three positions moves the body most.
    assert first.best == 0
    assert first.loss == pytest.approx(min(candidate.loss for candidate in first.candidates))
    assert torch.equal(first.actions, first.candidates[0].actions)
    assert first.positions.shape == (6, 60, 3)
    assert torch.equal(first.positions[-1], first.state.position[0])
    assert torch.equal(first.tool_poses[0], first.candidates[0].proposal.pose)
    assert placer.told[0] == [candidate.loss for candidate in first.candidates]
    assert result.gradient_evaluations == 2 * 3 * 3
    assert set(first.seconds) == {"transport", "placement", "optimization", "execution", "total"}
    # The toy's loss is the squared distance of the centres of mass; the body keeps its shape, so the metric is that distance.
    assert result.metric_initial == pytest.approx(result.loss_initial**0.5, rel=1e-2)
    assert result.metric_value == pytest.approx(result.loss_final**0.5, rel=1e-2)


def test_the_shape_is_judged_after_the_rest(make_toy_task):
    task = load_task(make_toy_task(step_count=3, rest_steps=2, stage_count=1))
    (stage,) = planner(task, iterations=3).run().stages
    assert stage.actions.shape == (5, 3)
    assert stage.actions[:3].any()
    assert not stage.actions[3:].any()
    assert stage.positions.shape == (6, 60, 3)
    assert torch.equal(stage.positions[-1], stage.state.position[0])


def test_a_state_that_moves_on_is_not_taken_to_be_at_rest(task):
    objective = ObjectiveTransport(OTSolverToy(), torch.as_tensor(task.load_goal()), coast_steps=4.0)
    state = SimulatorToy(task.scene, batch_size=1).initial_state(batch_size=1)
    losses = [
        float(objective.evaluate(still_trajectory(moving, 5, scene=task.scene)).loss)
        for moving in (state, dataclasses.replace(state, velocity=torch.full_like(state.velocity, 3.0)))
    ]
    step = 3.0 * 3.0**0.5 * task.scene.time_step * task.scene.substeps
    assert losses[1] - losses[0] == pytest.approx(4.0 * step, rel=1e-2)


def test_contact_points_that_gain_nothing_are_passed_on(task):
    class Spy(PlacerToy):
        def ask(self, stage):
            seen.append(stage.failed_contacts)
            return [dataclasses.replace(item, contact_particle=10 * stage.index + n) for n, item in enumerate(super().ask(stage))]

    seen = []
    made = planner(task, placer=Spy(count=2, spacing=0.0, rounds=1), iterations=2)
    result = made.run(stages=2)
    gains = [1.0 - stage.loss / stage.loss_before for stage in result.stages]
    assert seen == [(), () if gains[0] >= LEAST_GAIN else (0, 1)]
    small = [dataclasses.replace(stage, loss=0.995 * stage.loss_before) for stage in result.stages]
    assert failed_contacts(small) == (10, 11, 0, 1)
    assert failed_contacts([small[0], dataclasses.replace(small[1], loss=0.9 * small[1].loss_before)]) == ()
    assert failed_contacts([dataclasses.replace(small[0], loss=0.0), small[1]]) == (10, 11)


def test_placers_may_ask_again(task):
    result = planner(task, placer=PlacerToy(count=2, rounds=3)).run(stages=1)
    assert len(result.stages[0].candidates) == 6


def test_statuses_are_data_with_advice(task):
    broken = SimulatorToy(task.scene, batch_size=4, break_above=-2.0)
    cases = {
        Status.NO_PLACEMENT: planner(task, placer=PlacerToy(count=0)),
        Status.NON_FINITE: planner(task, simulator=broken),
        Status.NO_IMPROVEMENT: planner(task, placer=PlacerToy(spacing=30.0), iterations=2),
    }
    for status, made in cases.items():
        result = made.run()
        stage = result.stages[0]
        assert (result.status, len(result.stages)) == (status, 1)
        assert len(status.advice) > 20
        assert (stage.best, stage.actions, stage.positions, stage.tool_poses) == (None, None, None, None)
        assert torch.equal(stage.state.position, stage.state_before.position)
        assert result.loss_final == result.loss_initial == stage.loss
        assert math.isfinite(result.metric_value)
    assert Status.FINISHED.advice == ""


def test_a_plan_that_only_a_warm_start_flatters_is_not_executed(task):
    class Flattering(Objective):
        def evaluate(self, trajectory, warm=None):
            positions = trajectory.positions
            loss = torch.full((len(positions),), 1.0 if warm is None else 0.5)
            return ObjectiveResult(loss=loss, grad_positions=torch.zeros_like(positions), warm=("start",) * len(positions))

    made = dataclasses.replace(planner(task, iterations=2), objective=Flattering())
    (stage,) = made.run(stages=1).stages
    assert {candidate.loss for candidate in stage.candidates} == {0.5}
    assert (stage.status, stage.best, stage.actions, stage.loss) == (Status.NO_IMPROVEMENT, None, None, 1.0)
    assert torch.equal(stage.state.position, stage.state_before.position)


def test_what_came_before_a_failed_stage_is_kept(task):
    class Once(PlacerToy):
        def ask(self, stage):
            return super().ask(stage) if stage.index == 0 else []

    result = planner(task, placer=Once()).run(stages=3)
    assert [stage.status for stage in result.stages] == [Status.FINISHED, Status.NO_PLACEMENT]
    assert result.loss_final < result.loss_initial


@pytest.mark.parametrize("pruner", [PrunerNone(), PrunerHalving(least_iterations=1)])
def test_splitting_into_batches_changes_nothing(task, pruner):
    """Nor with successive halving, which compares all candidates of a round."""
    whole, split = (planner(task, placer=PlacerToy(count=5), batch_size=size, noise=0.3, pruner=pruner) for size in (5, 2))
    results = [made.run(stages=1).stages[0] for made in (whole, split)]
    assert (whole.simulator.largest_batch, split.simulator.largest_batch) == (5, 2)
    losses = [[candidate.loss for candidate in result.candidates] for result in results]
    assert losses[0] == pytest.approx(losses[1], rel=1e-12)
    torch.testing.assert_close(results[0].actions, results[1].actions)


def test_seeds_reproduce(task):
    actions = [planner(task, noise=0.3, iterations=2, seed=seed).run(stages=1).stages[0].actions for seed in (1, 1, 2)]
    assert torch.equal(actions[0], actions[1])
    assert not torch.equal(actions[0], actions[2])


def test_goes_on_from_a_state(task):
    whole = planner(task, noise=0.0, iterations=3).run(stages=2)
    first = planner(task, noise=0.0, iterations=3).run(stages=1)
    second = planner(task, noise=0.0, iterations=3).run(stages=1, state=first.state.to(dtype=torch.float32))
    assert second.loss_initial == pytest.approx(first.loss_final, rel=1e-5)
    # Adam makes full steps of gradients that are zero but for rounding, so that type conversion shows in the last digits.
    assert second.loss_final == pytest.approx(whole.loss_final, rel=0.1)
    with pytest.raises(InputError, match="single world"):
        planner(task).run(state=first.state.fork(2))
    with pytest.raises(InputError, match="particles"):
        planner(task).run(
            state=dataclasses.replace(
                first.state,
                **{name: getattr(first.state, name)[:, :5] for name in ("position", "velocity", "affine", "elastic_strain")},
            )
        )


def with_scene(task, **changes):
    return task.model_copy(update={"scene": task.scene.model_copy(update=changes)})


def test_capabilities_are_checked_before_any_work(task):
    class Stiff(SimulatorToy):
        capabilities = dataclasses.replace(SimulatorToy.capabilities, differentiable=False)

    tool = task.scene.tools[0]
    still = with_scene(task, tools=(tool.model_copy(update={"action_scale": ()}),))
    two = with_scene(task, tools=(tool, tool))
    inside = with_scene(task, tools=(tool.model_copy(update={"position": (0.4, 0.53, 0.4)}),))
    diary = Diary()
    cases = [
        (planner(task, solver=OTSolverExactToy(), observers=(diary,)), CapabilityError, "geomloss"),
        (planner(task, simulator=Stiff(task.scene), observers=(diary,)), CapabilityError, "Stiff has no gradient"),
        (planner(two, observers=(diary,)), CapabilityError, "places at most 1 movable tools, the scene has 2"),
        (planner(still, observers=(diary,)), InputError, "no movable tool"),
        (planner(inside, observers=(diary,)), InputError, r"scene\.tools\.0: got a Sphere that starts 0\.0\d+ length units"),
        (planner(task, simulator=SimulatorToy(two.scene), observers=(diary,)), InputError, "another scene"),
    ]
    for made, error, message in cases:
        with pytest.raises(error, match=message):
            made.run()
    with pytest.raises(InputError, match="stages: got 0, expected a whole number, at least 1"):
        planner(task, observers=(diary,)).run(stages=0)
    assert diary.entries == []


def test_exact_potentials_are_fine_where_no_priorities_are_needed(task):
    result = planner(task, solver=OTSolverExactToy(), placer=PlacerFixedToy()).run(stages=1)
    assert result.status is Status.FINISHED
    assert result.stages[0].priorities.isnan().all()


def test_deform_by_name_and_by_object(toy_task_file, toy_entry_points):
    registry = load_registry(toy_entry_points)
    optimizer = TrajectoryOptimizer(iterations=4)
    options = {"placer": "toy", "optimizer": optimizer, "registry": registry, "stages": 1}
    named = deform(str(toy_task_file), simulator="toy", ot_solver="toy", **options)
    assert named.names == {"backend": "toy", "ot": "toy", "placer": "toy", "strategy": "cpdeform"}
    task = load_task(toy_task_file)
    made = deform(task, simulator=SimulatorToy(task.scene, batch_size=8), ot_solver=OTSolverToy(), **options)
    assert made.names["backend"] == "SimulatorToy"
    assert made.loss_final == pytest.approx(named.loss_final)
    with pytest.raises(UnknownNameError, match='ot_solver: got "tyo"'):
        deform(task, simulator="toy", ot_solver="tyo", **options)


def test_deform_by_configuration(toy_task_file, toy_entry_points):
    registry = load_registry(toy_entry_points)
    configuration = RunConfiguration(
        task=str(toy_task_file),
        backend="toy",
        ot="toy",
        placer="toy",
        stages=1,
        scene={"bodies": {"0": {"particle_count": 20}}},
        placer_options={"count": 2},
        simulator_options={"batch_size": 1},
    )
    result = resolve(configuration, registry=registry).run()
    assert (result.state.particle_count, len(result.stages[0].candidates)) == (20, 2)
    bad = configuration.model_copy(update={"simulator_options": {"device": "cpu"}})
    with pytest.raises(InputError, match="Set device instead"):
        resolve(bad, registry=registry)
    shifted = configuration.model_copy(update={"priorities": PrioritiesConfiguration(kind="displacement")})
    with pytest.raises(
        InputError, match=r"transport solver toy has no option exponent\. Set it with --set priorities.kind=potential"
    ):
        resolve(shifted, registry=registry).run()


def test_priorities_may_be_displacements_which_an_exact_solver_has_too(task):
    for solver in (OTSolverToy(), OTSolverExactToy()):
        (stage,) = planner(task, solver=solver, problem=TransportProblem(exponent=2), iterations=2).run(stages=1).stages
        way = torch.as_tensor(task.load_goal()).mean(dim=0) - stage.state_before.position[0].mean(dim=0)
        assert torch.allclose(stage.priorities, way.norm().to(stage.priorities))
