"""`regil doctor --search`: encoders, k and horizon, tried on what was played."""

from __future__ import annotations

import re

import numpy as np
import pytest
import toy_camera
from regil_wrappers.encoders import encoders_at_hand, registry

from regil_sb3 import doctor
from regil_sb3.cli import main
from regil_sb3.doctor.search import candidates
from regil_sb3.settings import make_settings

ENV = "ToyCamera-v0"


class Blurred:
    """Sees how bright it is, roughly."""

    def encode(self, frames):
        return frames.mean(axis=(1, 2, 3), dtype=np.float32)[:, None].round(1)


@pytest.fixture(scope="module")
def demo():
    return toy_camera.record()


@pytest.fixture
def blurred(monkeypatch):
    monkeypatch.setattr(registry, "_factories", {**registry._factories, "blurred": Blurred})


def line(found, check):
    return next(f.line for f in found if f.check == check)


@pytest.mark.usefixtures("blurred")
def test_a_poor_encoder_is_told_from_a_good_one(demo):
    settings = make_settings(ENV, overrides=["encoder=blurred"])
    said = []
    found = doctor.examine(settings, demo, 1, said.append, ["pixels", "no-such"])
    recommended = line(found, "recommended")
    assert "--set encoder=pixels" in recommended
    assert re.search(r"--set k=\d+ --set horizon=\d+", recommended)
    assert "unknown" in line(found, "encoder no-such")
    assert re.match(r"k \d+, horizon \d: success above ", line(found, "encoder pixels"))
    assert re.search(r"plain guided replay [01] of 1$", line(found, "encoder pixels"))
    assert "trying encoder pixels" in said
    # as it was, and each of the two judged by the same episodes
    order = {name: float(re.search(r"order ([+-][\d.]+)", line(found, f"encoder {name}"))[1])
             for name in ("pixels", "blurred")}  # fmt: skip
    assert order["pixels"] > order["blurred"]


def test_where_nothing_is_better_nothing_is_recommended(demo):
    found = doctor.examine(ENV, demo, 1, encoders=["pixels?size=24"])
    assert "encoder=" not in line(found, "recommended")
    checks = [f.check for f in found if f.check.startswith("encoder")]
    assert set(checks) == {"encoder pixels", "encoder pixels?size=24"}


def test_without_actions_the_reward_alone_decides(demo):
    film = type(demo)(demo.frames, metadata=demo.metadata)
    found = doctor.examine(ENV, film, 1, encoders=["pixels?size=2"])
    assert "plain guided" not in line(found, "encoder pixels")


@pytest.mark.usefixtures("blurred")
def test_which_are_tried(monkeypatch, tmp_path):
    monkeypatch.setenv("REGIL_ENCODERS", str(tmp_path))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    settings = make_settings(ENV)
    names = candidates([], settings)
    assert names[0] == "pixels"
    assert {"pixels", "blurred"} <= set(names)
    assert candidates(["blurred"], settings) == ["pixels", "blurred"]
    pytest.importorskip("timm")
    assert "resnet18" not in encoders_at_hand()
    (tmp_path / "resnet18.a1_in1k.safetensors").touch()
    assert "resnet18" in encoders_at_hand()


def test_command_line(demo, tmp_path, capsys):
    demo.save(tmp_path / "demo.hdf5")
    words = ["doctor", ENV, str(tmp_path / "demo.hdf5"), "--episodes", "1", "--search"]
    assert main([*words, "pixels?size=14"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"ok +encoder pixels +k ", out)
    assert re.search(r"ok +encoder pixels\?size=14 +k ", out)
