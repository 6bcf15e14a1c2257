"""Heights from above: those of a board and of its groove, and letters that a reader for print reads."""

from __future__ import annotations

import dataclasses
import shutil
import subprocess

import imageio.v2
import numpy as np
import pytest
import torch

from cpdeform.core.task import load_task
from cpdeform.report.draw import draw_chosen
from cpdeform.report.heights import PIXEL, draw_heights, height_map, window_around
from cpdeform.run.record import load_record


def board(*, depth=0.0, spacing=0.005):
    """A board 0.4 x 0.1 x 0.2, its top at 0.1, with a groove along x, 0.04 wide."""
    axes = (np.arange(0.3, 0.7, spacing), np.arange(0.0, 0.1, spacing), np.arange(0.4, 0.6, spacing))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5 * spacing
    groove = (np.abs(points[:, 2] - 0.5) < 0.02) & (points[:, 1] > 0.1 - depth)
    return points[~groove]


def test_heights_of_a_board_with_a_groove():
    points = board(depth=0.04)
    window = window_around(points)
    assert window == pytest.approx((0.2825, 0.7175, 0.3825, 0.6175))
    heights = height_map(points, window=window)
    assert heights.shape == pytest.approx((0.235 / PIXEL, 0.435 / PIXEL), abs=1.0)
    row, column = (lambda z: int((z - window[2]) / PIXEL)), int((0.5 - window[0]) / PIXEL)
    assert heights[row(0.45), column] == pytest.approx(0.1, abs=0.002)
    assert heights[row(0.5), column] == pytest.approx(0.06, abs=0.002)
    assert np.isnan(heights[0]).all()
    # Seen from above the board has no holes.
    assert np.isfinite(heights[row(0.42) : row(0.58), column - 80 : column + 80]).all()
    assert not np.isfinite(height_map(points[:0], window=window)).any()


def test_clay_without_a_surface_is_dots(record):
    crumbs = np.array([[0.3, 0.1, 0.4], [0.6, 0.3, 0.5]])
    window = window_around(crumbs)
    heights = height_map(crumbs, window=window)
    rows, columns = np.nonzero(np.isfinite(heights))
    assert sorted(heights[rows, columns]) == [0.1, 0.3]
    np.testing.assert_allclose(np.sort(window[0] + PIXEL * columns), [0.3, 0.6], atol=PIXEL)
    sparse = dataclasses.replace(load_record(record(stages=1)), goal=torch.from_numpy(crumbs))
    assert imageio.v2.imread(draw_heights(sparse)).std() > 10.0


def test_a_shifted_board_is_shifted_in_the_picture():
    points = board(depth=0.04)
    window = window_around(points)
    shift = np.array([10 * PIXEL, 0.01, -5 * PIXEL])
    moved = height_map(points + shift, window=tuple(np.add(window, shift[[0, 0, 2, 2]])))
    np.testing.assert_allclose(moved, height_map(points, window=window) + 0.01, atol=1e-6)


def test_the_picture_of_a_run(record):
    directory = record(stages=1)
    assert draw_chosen(directory, ("heights",)) == [draw_heights(load_record(directory))]
    assert imageio.v2.imread(directory / "heights.png").std() > 10.0


@pytest.mark.skipif(shutil.which("tesseract") is None, reason="tesseract is not installed")
def test_the_goal_of_writer_can_be_read(tmp_path):
    goal = torch.as_tensor(load_task("writer++").load_goal()).double().numpy()
    # The board's edges are no part of the word.
    window = np.add(window_around(goal), (0.04, -0.04, 0.04, -0.04))
    heights = height_map(goal, window=tuple(window))
    top, bottom = np.nanpercentile(heights, (50.0, 2.0))
    level = np.clip((np.nan_to_num(heights, nan=top) - bottom) / (top - bottom), 0.0, 1.0)
    picture = np.pad((255.0 * level).repeat(3, axis=0).repeat(3, axis=1), 40, constant_values=255.0)
    imageio.v2.imwrite(tmp_path / "heights.png", picture.astype(np.uint8))
    letters = "tessedit_char_whitelist=ABCDEFGHIJKLMNOPQRSTUVWXYZ"
    command = ["tesseract", str(tmp_path / "heights.png"), "-", "--psm", "8", "-c", letters]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() == "ICLR"
