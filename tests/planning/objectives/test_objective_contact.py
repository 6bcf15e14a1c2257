"""The contact term against hand-written loops and finite differences."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from cpdeform.core.errors import InputError
from cpdeform.core.scene import BodyBox, Scene, ToolSphere
from cpdeform.core.state import tool_pose
from cpdeform.planning.objectives.contact import ContactKind, contact_loss


def scene(**options: Any) -> Scene:
    body = BodyBox(position=(0.5, 0.5, 0.5), widths=(0.2, 0.2, 0.2), particle_count=10)
    tools = (
        ToolSphere(position=(0.5, 0.7, 0.5), radius=0.05, action_scale=(0.01, 0.01, 0.01)),
        ToolSphere(position=(0.1, 0.1, 0.1), radius=0.05),
        ToolSphere(position=(0.2, 0.5, 0.5), radius=0.05, action_scale=(0.01, 0.01, 0.01)),
    )
    return Scene(bodies=(body,), tools=tools, **options)


def inputs() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    positions = 0.4 + 0.2 * torch.rand(2, 3, 10, 3, dtype=torch.float64, generator=generator)
    poses = tool_pose(scene()).expand(2, 3, 3, 8).clone()
    poses[..., :3] += 0.02 * torch.rand(2, 3, 3, 3, dtype=torch.float64, generator=generator)
    return positions, poses


@pytest.mark.parametrize("kind", ["hard", "soft"])
def test_equals_the_naive_loop_over_movable_tools(kind: ContactKind) -> None:
    positions, poses = inputs()
    loss = contact_loss(scene(), positions, poses, kind=kind)
    assert loss.shape == (2, 3)
    for world in range(2):
        for step in range(3):
            expected = 0.0
            for tool in (0, 2):
                gap = ((positions[world, step] - poses[world, step, tool, :3]).norm(dim=-1) - 0.05).clamp(min=0.0)
                weight = 1.0 / (1.0 + 1e4 * gap**2)
                distance = gap.min() if kind == "hard" else (weight * gap).sum() / weight.sum()
                expected += float(distance) ** 2
            assert float(loss[world, step]) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("kind", ["hard", "soft"])
def test_gradients(kind: ContactKind) -> None:
    positions, poses = inputs()
    assert torch.autograd.gradcheck(
        lambda x, pose: contact_loss(scene(), x, pose, kind=kind), (positions.requires_grad_(), poses.requires_grad_())
    )


def test_touching_tool_costs_nothing_and_no_tool_neither() -> None:
    positions, poses = inputs()
    poses[..., :3] = positions[..., :1, :]
    assert float(contact_loss(scene(), positions, poses).abs().max()) == 0.0
    bare = scene().model_copy(update={"tools": ()})
    assert float(contact_loss(bare, positions, poses[..., :0, :]).abs().max()) == 0.0


def test_unknown_kind_is_named() -> None:
    with pytest.raises(InputError, match='contact: got "softest", expected one of hard, soft'):
        contact_loss(scene(), *inputs(), kind="softest")  # type: ignore[arg-type]
