"""The page of a run that goes on."""

from __future__ import annotations

import json
import shutil
import threading
import urllib.error
import urllib.request

import h5py
import pytest

from cpdeform.core.errors import InputError
from cpdeform.report.page.encoding import decode_frames
from cpdeform.report.page.server import PageServer
from cpdeform.run.record_files import METRICS_FILE, stage_file


@pytest.fixture
def serve(tmp_path):
    servers = []

    def start(directory):
        server = PageServer(directory)
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
        servers.append(server)
        return server.address

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def get(address, **headers):
    request = urllib.request.Request(address, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=20.0) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read()


def test_it_serves_the_page_its_content_and_its_arrays(whole_record, serve):
    address = serve(whole_record)
    assert address.startswith("http://127.0.0.1:")
    status, text = get(address)
    assert status == 200
    assert b"connect-src 'self'" in text
    content = json.loads(get(address + "content.json")[1])
    assert len(content["stages"]) == 2
    status, data = get(address + "arrays/" + content["stages"][1]["positions"])
    assert decode_frames(data, particle_count=60).shape == (6, 60, 3)
    assert get(address + "arrays/nothing")[0] == 404
    assert get(address + "../run.json")[0] == 404


def test_other_names_of_this_machine_are_turned_away(whole_record, serve):
    """Else a page of any site could read the record, by a name of its own that leads to this machine."""
    address = serve(whole_record)
    assert get(address + "content.json", Host="evil.example")[0] == 403
    assert get(address + "content.json", Host="localhost:80")[0] == 200


def test_a_record_that_comes_later_and_grows(whole_record, serve, tmp_path):
    address = serve(tmp_path / "later")
    status, text = get(address + "content.json")
    assert status == 503
    assert b"later" in text
    shutil.copytree(whole_record, tmp_path / "later", ignore=shutil.ignore_patterns(stage_file(1)))
    assert len(json.loads(get(address + "content.json")[1])["stages"]) == 1
    shutil.copy(whole_record / stage_file(1), tmp_path / "later")
    assert len(json.loads(get(address + "content.json")[1])["stages"]) == 2


def test_the_browser_follows(browser, whole_record, serve, tmp_path):
    shutil.copytree(whole_record, tmp_path / "half", ignore=shutil.ignore_patterns(stage_file(1)))
    browser.open(serve(tmp_path / "half"))
    browser.wait_for("document.documentElement?.dataset.ready || document.documentElement?.dataset.error")
    assert browser.ask("cpdeform.player.content.stages.length") == 1
    shutil.copy(whole_record / stage_file(1), tmp_path / "half")
    browser.wait_for("cpdeform.player.content.stages.length === 2 && cpdeform.player.stage === 1")
    assert browser.complaints() == []


def test_a_stage_that_is_revised_is_shown_anew(browser, whole_record, serve, tmp_path):
    directory = shutil.copytree(whole_record, tmp_path / "revised")
    address = serve(directory)
    browser.open(address)
    browser.wait_for("document.documentElement?.dataset.ready || document.documentElement?.dataset.error")
    before = browser.ask("cpdeform.player.shown")
    first, second = (stage["positions"] for stage in json.loads(get(address + "content.json")[1])["stages"])
    with h5py.File(directory / stage_file(0), "a") as file:
        del file["positions"]
        with h5py.File(directory / stage_file(1)) as other:
            other.copy("positions", file)
    with (directory / METRICS_FILE).open("a") as file:
        file.write(json.dumps({"kind": "revision", "stage": 0, "stages": 1, "loss": 0.5}) + "\n")
    revised, kept = (stage["positions"] for stage in json.loads(get(address + "content.json")[1])["stages"])
    assert (revised != first, kept) == (True, second)
    assert get(address + "arrays/" + revised)[1] == get(address + "arrays/" + second)[1]
    assert get(address + "arrays/" + first)[0] == 404
    browser.wait_for(f"cpdeform.player.shown !== {json.dumps(before)}")
    assert browser.complaints() == []


def test_a_port_that_is_taken(whole_record, serve):
    port = int(serve(whole_record).rsplit(":", 1)[1].strip("/"))
    with pytest.raises(InputError, match="a free port"):
        PageServer("runs", port=port)
