"""The page of a run, as a file and in a browser."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil

import imageio.v3
import numpy as np
import pytest

from cpdeform.core.errors import InputError
from cpdeform.core.plugins import load_registry
from cpdeform.report.page.content import make_page
from cpdeform.report.page.encoding import decode_frames, spatial_order
from cpdeform.report.page.html import embedded_page
from cpdeform.report.page.write import write_page
from cpdeform.report.surface import particle_spacing
from cpdeform.run.record import load_record
from cpdeform.run.record_files import RUN_FILE


def content_of(text):
    return json.loads(re.search(r'<script type="application/json" id="content">(.*?)</script>', text).group(1))


def array_of(text, name):
    return base64.b64decode(re.search(rf'<script type="application/octet-stream" id="{name}">(.*?)</script>', text).group(1))


@pytest.fixture
def page(whole_record, tmp_path, toy_entry_points):
    directory = shutil.copytree(whole_record, tmp_path / "run")
    return write_page(directory, evaluate=False, registry=load_registry(toy_entry_points))


def test_the_file_holds_the_run(page):
    record = load_record(page.parent)
    text = page.read_text()
    content = content_of(text)
    assert content["name"] == "shift"
    assert [stage["loss"] for stage in content["stages"]] == [stage.loss for stage in record.stages]
    order = spatial_order(record.stages[0].state_before.position[0].double().numpy())
    for stage, described in zip(record.stages, content["stages"], strict=True):
        positions = decode_frames(array_of(text, described["positions"]), particle_count=60)
        np.testing.assert_allclose(positions, stage.positions.double().numpy()[:, order], atol=1e-5)
        np.testing.assert_allclose(described["poses"], stage.tool_poses.numpy(), atol=1e-5)
    assert [figure["name"] for figure in content["figures"]] == ["wasserstein"]
    assert len(content["curves"]) == sum(line["kind"] == "iteration" for line in record.metrics)


def test_the_tools_way_to_a_stage_leads_over_the_clay(page):
    record = load_record(page.parent)
    first, second = content_of(page.read_text())["stages"]
    assert "way" not in first
    way = np.array(second["way"])
    np.testing.assert_allclose(way[0], record.stages[0].tool_poses[-1], atol=1e-5)
    np.testing.assert_allclose(way[-1], record.stages[1].tool_poses[0], atol=1e-5)
    highest = float(record.stages[1].state_before.position[..., 1].max())
    assert way[:, 0, 1].max() > highest
    # Nowhere does a tool go aside but above the clay.
    level = np.abs(np.diff(way[:, 0], axis=0)[:, [0, 2]]).max(axis=1) > 1e-6
    assert (way[:-1, 0, 1][level] > highest).all()


def test_candidates_that_lost_are_rolled_out(record, toy_entry_points):
    from cpdeform_toy.parts import PlacerFixedToy

    class Twice(PlacerFixedToy):
        def ask(self, stage):
            return [*super().ask(stage), *super().ask(stage)]

    told = []
    directory = record(placer=Twice())
    text = write_page(directory, evaluate=False, told=told.append, registry=load_registry(toy_entry_points)).read_text()
    stage = content_of(text)["stages"][0]
    assert len(stage["candidates"]) == 2
    lost = stage["candidates"][1 - stage["best"]]
    assert lost["frames"] == stage["frames"]
    assert any("lost" in line for line in told)
    positions = decode_frames(array_of(text, lost["positions"]), particle_count=60)
    start = decode_frames(array_of(text, stage["positions"]), particle_count=60)[0]
    np.testing.assert_allclose(positions[0], start, atol=2e-5)
    # Without the simulator that made the run they are shown as placed.
    told.clear()
    text = write_page(directory, evaluate=False, told=told.append, registry=load_registry([])).read_text()
    assert content_of(text)["stages"][0]["candidates"][1 - stage["best"]]["positions"] is None
    assert any("as placed" in line for line in told)


def test_text_of_a_task_cannot_leave_its_element(page):
    path = page.parent / RUN_FILE
    run = json.loads(path.read_text())
    run["task"]["summary"] = "</script><script>document.title='taken'</script>"
    path.write_text(json.dumps(run))
    text = embedded_page(make_page(load_record(page.parent)))
    assert "</script><script>document" not in text
    assert content_of(text)["summary"] == run["task"]["summary"]


def test_nothing_to_show(tmp_path):
    with pytest.raises(InputError, match=r"no run\.json"):
        write_page(tmp_path)


def opened(browser, page, hash=""):
    browser.open(page.as_uri() + hash)
    browser.wait_for("document.documentElement?.dataset.ready || document.documentElement?.dataset.error")
    assert browser.complaints() == []
    assert browser.ask("document.documentElement.dataset.error ?? null") is None


def picture_of(browser):
    """The canvas, pixels (H, W, 3)."""
    browser.ask("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    picture = imageio.v3.imread(io.BytesIO(browser.screenshot()))[..., :3].astype(int)
    box = "document.getElementById('canvas').getBoundingClientRect()"
    x, y, width, height = browser.ask(f"(({{x, y, width, height}}) => [x, y, width, height].map(Math.round))({box})")
    return picture[y : y + height, x : x + width]


def seen_at(browser, places):
    """Pixels (K, 2), down and right, of places (K, 3) in the canvas."""
    script = f"""{json.dumps(np.asarray(places).tolist())}.map((place) => {{
      const {{ camera, renderer: {{ domElement }} }} = cpdeform.view;
      const seen = new libraries.Vector3(...place).project(camera);
      return [(0.5 - 0.5 * seen.y) * domElement.clientHeight, (0.5 + 0.5 * seen.x) * domElement.clientWidth];
    }})"""
    return np.array(browser.ask(script))


def is_clay(picture):
    """Whether pixels (..., 3) are of the clay's colours: red above green above blue, away from the greys around it."""
    return (picture[..., 0] - picture[..., 2] > 25) & (picture[..., 0] >= picture[..., 1])


def test_clay_is_where_the_clay_is(browser, page):
    """Pixels at the particles are clay, those elsewhere are not; at the end, when the clay has moved, too."""
    record = load_record(page.parent)
    opened(browser, page)
    browser.ask("for (const tool of cpdeform.view.tools) tool.mesh.material.uniforms.opacity.value = 0")
    browser.ask("for (const id of ['legend', 'caption']) document.getElementById(id).style.display = 'none'")
    for stage, step in ((1, 0), (len(record.stages), 5)):
        browser.ask(f"cpdeform.player.goTo({stage - 1}, {step})")
        picture = picture_of(browser)
        particles = record.stages[stage - 1].positions[step].double().numpy()
        pixels = np.round(seen_at(browser, particles)).astype(int)
        # The surface of a few particles is drawn somewhat inside of the outermost ones.
        middle = np.median(pixels, axis=0).astype(int)
        inner = (middle + 0.5 * (pixels - middle)).astype(int)
        assert is_clay(picture[tuple(inner.T)]).mean() > 0.95
        rows, columns = np.nonzero(is_clay(picture))
        assert len(rows) > 200
        reach = 0.75 * particle_spacing(particles) * np.ptp(pixels[:, 1]) / np.ptp(particles[:, 0])
        low, high = pixels.min(axis=0) - reach, pixels.max(axis=0) + reach
        assert (rows >= low[0]).all()
        assert (rows <= high[0]).all()
        assert (columns >= low[1]).all()
        assert (columns <= high[1]).all()


def test_it_plays_without_asking_the_network(browser, page):
    opened(browser, page, "#play=1")
    browser.wait_for("cpdeform.player.stage === 1")
    browser.wait_for("cpdeform.player.stage === 0")
    browser.ask("cpdeform.player.play(false)")
    assert {address.partition("#")[0] for address in browser.requests()} == {page.as_uri()}
    assert browser.ask("fetch('http://127.0.0.1:9/').then(() => 'asked', () => 'refused')") == "refused"


def test_the_tools_are_seen_on_their_way(browser, page):
    opened(browser, page)
    way = content_of(page.read_text())["stages"][1]["way"]
    browser.ask("cpdeform.player.goTo(0, 5)")
    browser.ask("cpdeform.player.play(true)")
    browser.wait_for("cpdeform.player.stage === 1 && document.getElementById('caption').textContent.includes('on their way')")
    browser.ask("cpdeform.player.play(false)")
    found = "(cpdeform.player.showWay(cpdeform.player.current.way, SHARE), cpdeform.view.tools[0].mesh.position.toArray())"
    for share, pose in ((0, way[0][0]), (1, way[-1][0])):
        assert browser.ask(found.replace("SHARE", str(share))) == pytest.approx(pose[:3], abs=1e-6)
    browser.ask("cpdeform.player.goTo(1, 0)")
    assert "on their way" not in browser.ask("document.getElementById('caption').textContent")


def test_colours_goal_and_particles_change_the_picture(browser, page):
    opened(browser, page)
    pictures = [picture_of(browser)]
    for id_or_colour in ("[data-colour=priority]", "[data-colour=error]", "#goal", "#particles"):
        browser.ask(f"document.querySelector('{id_or_colour}').click()")
        browser.ask("new Promise((done) => setTimeout(done, 100))")
        pictures.append(picture_of(browser))
        assert (np.abs(pictures[-1] - pictures[-2]).max(axis=-1) > 12).sum() > 50, id_or_colour
    assert browser.complaints() == []


def test_the_browser_reads_what_python_wrote_and_what_the_address_says(browser, page):
    """Positions in the browser are those of the record to half a step of 16 bits."""
    record = load_record(page.parent)
    opened(browser, page, "#stage=2&step=3&colour=error&goal=1")
    player = browser.ask("[cpdeform.player.stage, cpdeform.player.time, cpdeform.player.colour, cpdeform.player.showGoal]")
    assert player == [1, 3, "error", True]
    assert browser.ask("document.getElementById('caption').textContent").startswith("stage 2 of 2, step 3 of 5")
    found = browser.ask("cpdeform.player.frames('stage-0-positions').then((frames) => frames.map((frame) => Array.from(frame)))")
    order = spatial_order(record.stages[0].state_before.position[0].double().numpy())
    wanted = record.stages[0].positions.double().numpy()[:, order]
    assert np.abs(np.array(found).reshape(wanted.shape) / 65535 - wanted).max() <= 0.51 / 65535


def test_the_page_follows_a_changed_address(browser, page):
    opened(browser, page, "#stage=1&goal=1")
    browser.ask("void (location.hash = '#stage=2&step=3&colour=error')")
    browser.wait_for("cpdeform.player.stage === 1 && cpdeform.player.time === 3 && cpdeform.player.colour === 'error'")
    # What the address does not name stays as it is.
    assert browser.ask("cpdeform.player.showGoal") is True
    browser.ask("void (location.hash = '#goal=0')")
    browser.wait_for("!cpdeform.player.showGoal")
    assert browser.ask("[cpdeform.player.stage, cpdeform.player.time]") == [1, 3]
    assert browser.complaints() == []
