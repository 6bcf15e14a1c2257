"""Particles inside bodies."""

from __future__ import annotations

import numpy as np
import pytest
from golden import NAMES, golden_path
from hypothesis import given
from hypothesis import strategies as st

from cpdeform.core.sampling import body_index, sample_particles, solid_index
from cpdeform.core.scene import BodyBox, BodySphere, Scene
from cpdeform.core.task import load_task

TASKS_BY_RECORDING = {
    "multistage_airplane-v1": "airplane",
    "multistage_star-v1": "star",
    "pinch-v2": "pinch",
    "rollingpin-v2": "rolling-pin-v2",
    "triplemove-v2": "triple-move-v2",
}


@given(
    position=st.tuples(*[st.floats(0.3, 0.6)] * 3),
    widths=st.tuples(*[st.floats(0.01, 0.4)] * 3),
    radius=st.floats(0.01, 0.2),
    seed=st.integers(0, 1000),
    sampling=st.sampled_from(["uniform", "plasticinelab"]),
)
def test_particles_fill_their_bodies(position, widths, radius, seed, sampling):
    block = BodyBox(position=position, widths=widths, particle_count=50)
    ball = BodySphere(position=position, radius=radius, particle_count=30)
    scene = Scene(bodies=(block, ball), sampling=sampling, sampling_seed=seed)
    particles = sample_particles(scene)
    assert particles.shape == (80, 3)
    assert (np.abs(particles[:50] - position) <= np.asarray(block.half_extents) + 1e-12).all()
    assert (np.linalg.norm(particles[50:] - position, axis=1) <= radius + 1e-12).all()
    np.testing.assert_array_equal(particles, sample_particles(scene))
    assert body_index(scene).tolist() == [0] * 50 + [1] * 30


def test_bodies_that_share_grid_nodes_are_one_solid():
    positions = {"leg": (0.3, 0.1, 0.3), "top": (0.4, 0.17, 0.4), "far leg": (0.5, 0.1, 0.5), "apart": (0.8, 0.1, 0.8)}
    widths = {"leg": (0.04, 0.1, 0.04), "top": (0.3, 0.04, 0.3), "far leg": (0.04, 0.1, 0.04), "apart": (0.04, 0.1, 0.04)}
    bodies = tuple(BodyBox(position=positions[name], widths=widths[name], particle_count=500) for name in positions)
    assert solid_index(Scene(bodies=bodies)).tolist() == [0] * 1500 + [1] * 500
    # The top of the same table on a grid so fine that its gap to the legs, about 0.005, is many cells wide.
    raised = bodies[1].model_copy(update={"position": (0.4, 0.175, 0.4)})
    assert len(set(solid_index(Scene(bodies=(bodies[0], raised, *bodies[2:]), grid_size=512)).tolist())) == 4


@pytest.mark.parametrize("sampling", ["uniform", "plasticinelab"])
def test_density_is_uniform(sampling):
    block = BodyBox(position=(0.5, 0.5, 0.5), widths=(0.2, 0.4, 0.1), particle_count=20000)
    ball = BodySphere(position=(0.5, 0.5, 0.5), radius=0.2, particle_count=20000)
    particles = sample_particles(Scene(bodies=(block, ball), sampling=sampling)) - 0.5
    corner = (particles[:20000] > 0.25 * np.asarray(block.widths)).all(axis=1).mean()
    core = (np.linalg.norm(particles[20000:], axis=1) < 0.1).mean()
    # a sixty-fourth of the block and an eighth of the ball; four standard deviations of the counts
    assert abs(corner - 1 / 64) < 4 * np.sqrt(1 / 64 / 20000)
    assert abs(core - 1 / 8) < 4 * np.sqrt(1 / 8 / 20000)


def test_samplings_and_seeds_differ():
    scenes = [
        Scene(bodies=(BodySphere(position=(0.5, 0.5, 0.5), radius=0.2, particle_count=5),), sampling=sampling, sampling_seed=seed)
        for sampling in ("uniform", "plasticinelab")
        for seed in (0, 1)
    ]
    samples = [sample_particles(scene) for scene in scenes]
    assert all((samples[i] != samples[j]).all() for i in range(4) for j in range(i))


@pytest.mark.parametrize("name", NAMES)
def test_particles_of_plasticinelab(name):
    with np.load(golden_path(name)) as recording:
        recorded = recording["x0"]
    task = load_task(TASKS_BY_RECORDING.get(name, name))
    scene = task.scene.model_copy(update={"sampling": "plasticinelab"})
    # The last digit of a sine depends on the processor.
    np.testing.assert_allclose(sample_particles(scene), recorded, rtol=0.0, atol=1e-15)
