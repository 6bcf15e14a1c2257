"""Random goals: volume, rest, place, connectedness, thickness, and the same file for the same seed."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.core.errors import InputError
from cpdeform.core.goal import load_correspondence, load_goal
from cpdeform.core.plugins import AUTO, load_registry
from cpdeform.core.sampling import body_index, sample_particles
from cpdeform.core.task import changed_task, load_task
from cpdeform.planning.rest import rest_scene, settle_goal
from cpdeform.tasks.generate.goal import GeneratedGoal, generate_goal
from cpdeform.tasks.generate.layouts import random_cubes, random_rope
from cpdeform.tasks.generate.motions import dent_motion, pen_motion, script_motion
from cpdeform.tasks.generate.outlines import FIGURES, box, lines
from cpdeform.tasks.generate.random_solids import LOST_SHARE, REACH, random_solid, rest_height, thin_shares
from cpdeform.tasks.single_stage import SCRIPTS
from cpdeform.tasks.solids import Block, Solid, body_volume


def small(name, count=1500):
    """A task with fewer particles."""
    task = load_task(name)
    bodies = {str(number): {"particle_count": count // len(task.scene.bodies)} for number in range(len(task.scene.bodies))}
    return changed_task(task, scene={"bodies": bodies})


def voxels(solid, size=1 / 160):
    lower, upper = solid.corners
    axes = [np.arange(low + 0.5 * size, high, size) for low, high in zip(lower, upper, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return solid.contains(points.reshape(-1, 3)).reshape(points.shape[:3])


@pytest.mark.parametrize(("name", "seed"), [("star", 0), ("airplane", 1000), ("chair", 1000), ("bottle", 0)])
def test_solids_are_the_clay_in_one_piece(name, seed):
    scene = load_task(name).scene
    kind, solid = random_solid(scene, np.random.default_rng(seed))
    cells = voxels(solid)
    volume = sum(body_volume(body) for body in scene.bodies)
    lower, upper = solid.corners
    points = lower + np.random.default_rng(1).random((200_000, 3)) * (upper - lower)
    assert np.prod(upper - lower) * solid.contains(points).mean() == pytest.approx(volume, rel=0.01), kind
    assert ndimage.label(cells)[1] == 1
    assert max(thin_shares(solid)) <= LOST_SHARE
    body = scene.bodies[0]
    for axis in (0, 2):
        assert lower[axis] >= body.position[axis] - body.half_extents[axis] - REACH - 1e-9
        assert upper[axis] <= body.position[axis] + body.half_extents[axis] + REACH + 1e-9
    assert solid.contains(np.array([[x, rest_height(scene) - 1e-3, 0.5] for x in np.linspace(0.2, 0.8, 50)])).sum() == 0


def test_figures_are_in_one_piece_whatever_the_seed():
    from cpdeform.tasks.generate.outlines import prisms

    for name, make in FIGURES.items():
        for seed in range(3):
            part = prisms(make(np.random.default_rng(seed)), 0.4, 0.41)
            x, z = np.meshgrid(np.linspace(-0.5, 1.5, 200), np.linspace(-0.5, 1.5, 200))
            points = np.stack([x.ravel(), np.full(x.size, 0.405), z.ravel()], axis=1)
            assert ndimage.label(part.contains(points).reshape(x.shape), structure=np.ones((3, 3)))[1] == 1, name


def test_thin_shares_against_closed_forms():
    slab = Solid(parts=(Block((0.3, 0.3, 0.3), (0.6, 0.4, 0.6)),), origin=(0.3, 0.3, 0.3))
    thin, gaps = thin_shares(slab)
    # No ball of radius r fits into an edge: (1 - pi / 4) r^2 is left of it, along 2.8 of edges of a volume of 0.009.
    assert thin == pytest.approx((1.0 - np.pi / 4.0) * 0.025**2 * 2.8 / 0.009, abs=0.03)
    assert gaps == 0.0
    # A fin of 0.02 on the slab has 0.3 * 0.02 * 0.1 of its volume.
    fin = Solid(parts=(*slab.parts, Block((0.44, 0.4, 0.3), (0.46, 0.5, 0.6))), origin=(0.3, 0.3, 0.3))
    assert thin_shares(fin)[0] - thin == pytest.approx(0.0006 / 0.0096, rel=0.35)
    # Two slabs with a gap of 0.03 between them.
    gap = Solid(parts=(*slab.parts, Block((0.63, 0.3, 0.3), (0.9, 0.4, 0.6))), origin=(0.3, 0.3, 0.3))
    assert thin_shares(gap)[1] == pytest.approx(0.03 * 0.1 * 0.3 / (0.57 * 0.1 * 0.3), rel=0.35)
    assert len(lines([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)], 0.1)) == 6
    assert box(0.0, 0.0, 1.0, 2.0)[2] == (1.0, 2.0)


@pytest.mark.parametrize("seed", range(4))
def test_ropes_keep_their_length_and_leave_room(seed):
    scene = small("rope++").scene
    start, position = sample_particles(scene), random_rope(scene, np.random.default_rng(seed))
    assert position.shape == start.shape
    # Neighbours along the middle line stay where they are to each other: nothing is stretched.
    near = cKDTree(start).query_pairs(0.03, output_type="ndarray")
    before, after = (np.linalg.norm(cloud[near[:, 0]] - cloud[near[:, 1]], axis=1) for cloud in (start, position))
    assert np.median(np.abs(after / before - 1.0)) < 0.1
    assert np.linalg.norm(position - start, axis=1).max() >= 0.1
    assert position[:, [0, 2]].min() > 0.07
    assert position[:, [0, 2]].max() < 0.93


@pytest.mark.parametrize("seed", range(4))
def test_cubes_are_moved_whole_and_apart(seed):
    scene = small("move++").scene
    start, position = sample_particles(scene), random_cubes(scene, np.random.default_rng(seed))
    owners, tree = body_index(scene), cKDTree(position)
    for number in range(len(scene.bodies)):
        way = (position - start)[owners == number]
        np.testing.assert_allclose(way, np.broadcast_to(way[0], way.shape), atol=1e-12)
        assert way[0][1] == 0.0
        assert 0.08 <= np.hypot(way[0][0], way[0][2]) <= 0.24
    pairs = tree.query_pairs(0.055, output_type="ndarray")
    assert (owners[pairs[:, 0]] == owners[pairs[:, 1]]).all()


def test_motions_stay_within_actions_and_board():
    writer, pinch = load_task("writer++").scene, load_task("pinch").scene
    kinds = set()
    for seed in range(12):
        kind, legs = pen_motion(writer, np.random.default_rng(seed))
        kinds.add(kind if len(kind) > 8 else "word")
        starts = np.array([leg.start[0] for leg in legs if leg.start])
        board = writer.bodies[0]
        assert (np.abs(starts[:, 0] - board.position[0]) < board.half_extents[0] - 0.05).all()
        assert (np.abs(starts[:, 2] - board.position[2]) < board.half_extents[2] - 0.04).all()
        for leg in legs:
            assert float(leg.action_rows(writer).abs().max()) <= 1.0
        # The pen comes up again as far as it went down.
        assert sum(float(leg.action_rows(writer)[:, 1].sum()) for leg in legs) == pytest.approx(0.0, abs=1e-9)
        _, dents = dent_motion(pinch, np.random.default_rng(seed))
        assert 6 <= len(dents) <= 10
        assert max(float(leg.action_rows(pinch).abs().max()) for leg in dents) <= 1.0
    assert len(kinds) >= 3


@pytest.mark.parametrize("name", sorted(SCRIPTS))
def test_variations_of_scripts_are_motions_of_the_scene(name):
    scene = load_task(name).scene
    rows = [torch.cat([leg.action_rows(scene) for leg in script_motion(scene, name, np.random.default_rng(k))]) for k in (0, 0, 1)]
    assert rows[0].shape[1] == scene.action_size
    assert torch.equal(rows[0], rows[1])
    assert rows[0].shape != rows[2].shape or not torch.equal(rows[0], rows[2])
    for seed in range(200):
        for leg in script_motion(scene, name, np.random.default_rng(seed)):
            assert float(leg.action_rows(scene).abs().max()) <= 1.0


@pytest.mark.parametrize(("name", "seed"), [("star", 1), ("move++", 0)])
def test_goals_are_at_rest(name, seed):
    task = small(name, 4500 if name == "star" else 3000)
    goal = generate_goal(task, seed=seed)
    registry = load_registry()
    backend = registry.resolve("simulator", AUTO, device="cpu")
    simulator = registry.create("simulator", backend, scene=rest_scene(task.scene))
    again = settle_goal(simulator, torch.as_tensor(goal.position))
    # Let go, it keeps its place to half a cell, and its shape.
    assert abs(again.drop) < 0.5 / 64
    assert again.self_iou >= 0.85
    motion = np.linalg.norm(again.let_go.numpy() - goal.position, axis=1)
    assert np.median(motion) < 0.5 / 64
    lower, upper = task.scene.domain
    assert (goal.position >= lower).all()
    assert (goal.position <= upper).all()
    assert goal.position[:, 1].min() >= rest_height(task.scene) - 0.5 / 64
    assert len(goal.position) == task.scene.particle_count


def test_dents_are_made_by_the_ball():
    task = small("pinch", 4000)
    goal = generate_goal(task, seed=2)
    start = sample_particles(task.scene)
    assert goal.corresponds
    motion = np.linalg.norm(goal.position - start, axis=1)
    assert motion.max() > 0.03  # the ball pressed some clay in
    assert motion.max() > 2.0 * np.median(motion)  # and that more than it pushed the block as a whole


def test_the_same_seed_gives_the_same_file(tmp_path):
    task = small("rope++", 4500)
    goals = [generate_goal(task, seed=seed) for seed in (7, 7, 1007)]
    for number, goal in enumerate(goals):
        goal.write(tmp_path / "made" / f"{number}.npz")
    contents = [(tmp_path / "made" / f"{number}.npz").read_bytes() for number in range(3)]
    assert contents[0] == contents[1]
    assert contents[0] != contents[2]
    path = tmp_path / "made" / "0.npz"
    assert load_goal(path, scene=task.scene).shape == (4500, 3)
    assert load_correspondence(path)
    assert [goal.for_reporting for goal in goals] == [False, False, True]


def test_the_command(tmp_path, monkeypatch):
    def invoke(*arguments):
        return CliRunner().invoke(app, ["task", "generate", *map(str, arguments)])

    def quick(task, *, seed, backend):
        position = sample_particles(task.scene)
        return GeneratedGoal(task=task.name, seed=seed, kind="a lump", position=position, corresponds=True, self_iou=1.0)

    out = tmp_path / "goal.npz"
    for arguments, message in (
        (("star", "--seed", -1, "--out", out), "--seed: got -1, expected 0 or more"),
        (("star", "--seed", 1, "--out", tmp_path / "goal.h5"), "ends in .npz"),
        (("stra", "--seed", 1, "--out", out), 'Did you mean "star"?'),
    ):
        found = invoke(*arguments)
        assert found.exit_code == 2
        assert message in found.stderr
    monkeypatch.setattr("cpdeform.tasks.generate.goal.generate_goal", quick)
    made = invoke("star", "--seed", 1000, "--out", out)
    assert made.exit_code == 0, made.output
    assert "a lump for star, 10000 particles, seed 1000 (for reporting only)" in made.stdout
    assert "which exists" in invoke("star", "--seed", 3, "--out", out).stderr
    assert "(for tuning)" in invoke("star", "--seed", 3, "--out", out, "--overwrite").stdout
    (tmp_path / "file").write_text("")
    blocked = invoke("star", "--seed", 3, "--out", tmp_path / "file" / "goal.npz")
    assert "cannot be written" in blocked.stderr
    assert "reporting" in CliRunner().invoke(app, ["task", "generate", "--help"], env={"COLUMNS": "200"}).stdout


def test_scenes_without_room_are_refused(monkeypatch):
    with pytest.raises(InputError, match="seed: got -3"):
        generate_goal(load_task("star"), seed=-3)
    with pytest.raises(InputError, match=r"scene\.tools\.0: got a Capsule"):
        dent_motion(load_task("writer").scene, np.random.default_rng(0))
    tiny = changed_task(load_task("star"), scene={"bodies": {"0": {"widths": [0.05, 0.02, 0.05]}}})
    monkeypatch.setattr("cpdeform.tasks.generate.random_solids.ATTEMPTS", 1)
    with pytest.raises(InputError, match="clay of which no solid could be made"):
        random_solid(tiny.scene, np.random.default_rng(0))
