"""What the report shows of a correcting guide."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import toy_camera
from regil_wrappers import RetrievalGuideWrapper

from regil_sb3.report import run_page
from regil_sb3.report.guide_view import guide_picture, guide_view
from regil_sb3.report.run_page import write_report


def calibrate(task):
    demo = toy_camera.record(task=task)
    env = RetrievalGuideWrapper(toy_camera.ToyCamera(task), demo, correction="servo")
    seed = 0
    while env.calibration() is None:
        _, over = env.reset(seed=(seed := seed + 1)), False
        while not over:
            *_, terminated, truncated, _ = env.step(env.guide_action())
            over = terminated or truncated
    return demo, json.loads(json.dumps(env.calibration()))


@pytest.fixture(scope="module")
def calibrated():
    return calibrate("touch")


def test_two_things_that_moved_apart():
    demo, calibration = calibrate("bring")
    env = toy_camera.ToyCamera("bring")
    both = 0
    for seed in range(6):
        first, _ = env.reset(seed=seed)
        view = guide_view(demo, first, calibration)
        if len(view.things) < 2:
            continue
        both += 1
        taken, place = view.things
        assert (taken.what, place.what)[1] == "the place to which it is brought"
        assert np.linalg.norm((taken.shift - (env.square - toy_camera.HOME))[:2]) < 0.6
        assert np.linalg.norm((place.shift - (env.goal - toy_camera.GOAL))[:2]) < 1.6
        assert np.abs(place.believed - toy_camera.project(env.goal)[0]).max() < 8
        picture = guide_picture(demo, first, view)
        assert picture.count("<circle") == 6
    assert both >= 4
    older = {name: value for name, value in calibration.items() if name != "gripper_dim"}
    assert len(guide_view(demo, first, older).things) == 1


def test_the_target_is_believed_where_it_is(calibrated):
    demo, calibration = calibrated
    env = toy_camera.ToyCamera()
    for seed in range(4):
        first, _ = env.reset(seed=seed)
        view = guide_view(demo, first, calibration)
        true = toy_camera.project(env.square)[0]
        (target,) = view.things
        assert np.abs(target.believed - true).max() < 6  # of the square, the part that was seen
        np.testing.assert_allclose(target.shift, env.square - toy_camera.HOME, atol=0.8)
        assert view.path.shape == view.corrected.shape == (len(demo.actions), 2)
        assert np.abs(view.corrected[-1] - true).max() < 4
    picture = guide_picture(demo, first, view)
    assert picture.count("<image") == 2
    assert len(picture) < 40_000


def test_where_it_would_not_correct_there_is_no_picture(calibrated):
    demo, calibration = calibrated
    assert guide_view(demo, demo.frames[0], calibration) is None  # nothing moved
    plain = [way for way in calibration["ways"] if way[0] == "plain"]
    first, _ = toy_camera.ToyCamera().reset(seed=1)
    assert guide_view(demo, first, {**calibration, "cameras": [], "ways": plain}) is None
    assert guide_picture(demo, first, None) == ""
    with pytest.raises(ValueError, match="calibrat"):
        guide_view(demo, first, {**calibration, "ways": []})
    with pytest.raises(ValueError, match="translation_dims"):
        guide_view(demo, first, {"ways": []})


def test_a_demonstration_that_states_no_limits(calibrated):
    demo, calibration = calibrated
    limits = {"action_low": None, "action_high": None}
    bare = dataclasses.replace(demo, metadata={**demo.metadata, **limits})
    first, _ = toy_camera.ToyCamera().reset(seed=1)
    seen, stated = (guide_view(one, first, calibration) for one in (bare, demo))
    np.testing.assert_array_equal(seen.corrected, stated.corrected)


def test_the_report_shows_it(calibrated, tmp_path, monkeypatch):
    demo, calibration = calibrated
    demo.save(tmp_path / "demo.hdf5")
    other = toy_camera.ToyCamera()
    first, _ = other.reset(seed=1)
    episode = type(demo)(np.stack([first, *demo.frames[1:]]), actions=demo.actions)
    episode.save(tmp_path / "episode.hdf5")
    (tmp_path / "config.yaml").write_text("env: ToyCamera-v0\n")
    assert "What the guide sees" not in write_report(tmp_path).read_text()
    (tmp_path / "calibration.json").write_text(json.dumps(calibration))
    assert "What the guide sees" in write_report(tmp_path).read_text()
    (tmp_path / "calibration.json").write_text("{}")
    assert "calibration.json cannot be used" in write_report(tmp_path).read_text()
    for part in ("align", "guide_view"):  # whatever goes wrong in one
        monkeypatch.setattr(run_page, part, lambda *_: np.zeros(1)[2])
    page = write_report(tmp_path).read_text()
    assert "alignment: index 2 is out of bounds" in page
    assert "calibration.json cannot be used: index 2 is out of bounds" in page
