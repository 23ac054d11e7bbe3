"""Models open without running what they hold."""

from __future__ import annotations

import base64
import io
import json
import os
import pickle
import zipfile

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from test_td3bc import small
from toy import demonstration, stacked

from regil_sb3 import TD3BC
from regil_sb3.bc_schedule import BySuccess


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "model.zip"
    model = small(stacked())
    model.learn(30)
    model.save(path)
    return path


def with_pickle(saved, path, pickled, key="lr_schedule"):
    """The same model, with this in place of one of the things that SB3 pickles."""
    with zipfile.ZipFile(saved) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name == "data":
                data = json.loads(content)
                assert key in data
                data[key] = {":type:": "x", ":serialized:": base64.b64encode(pickled).decode()}
                content = json.dumps(data).encode()
            new.writestr(name, content)
    return path


class Call:
    """Pickles as a call."""

    def __init__(self, function, *arguments):
        self.called = (function, arguments)

    def __reduce__(self):
        return self.called


def touch(path):
    return f"open({str(path)!r}, 'w').close()"


def pickles(marker):
    command = f"touch {marker}"
    line = touch(marker)
    yield "os.system", pickle.dumps(Call(os.system, command))
    yield "exec", pickle.dumps(Call(exec, line))
    yield "eval", pickle.dumps(Call(eval, line))
    yield "getattr", pickle.dumps(Call(getattr, dict, "fromkeys"))
    yield "import", pickle.dumps(Call(__import__, "antigravity"))
    yield "cloudpickle", cloudpickle.dumps(lambda _: os.system(command))
    yield "a class of its own", cloudpickle.dumps(type("Net", (), {"__call__": lambda self: 1}))
    yield "in a known one", pickle.dumps({"state": [Call(os.system, command)]})
    for protocol in range(3):
        yield f"protocol {protocol}", pickle.dumps(Call(os.system, command), protocol)
    yield "INST", b"(S'" + command.encode() + b"'\nios\nsystem\n."
    yield "OBJ", b"(cos\nsystem\nS'" + command.encode() + b"'\no."
    yield "dotted", b"\x80\x04\x8c\x0bcollections\x8c\x0edeque.__init__\x93."
    yield "EXT", b"\x80\x02\x82\x01."
    yield "persistent", b"Pos.system\n."
    yield "a class changed", pickle.dumps(BySuccess)[:-1] + b"}\x8c\x05shareK\x01sb."
    yield "huge", pickle.dumps(Call(gym.spaces.Box, 0, 1, (10**7, 10**7)))
    yield "huge array", pickle.dumps(Call(np.zeros, 10**13))
    wide = Call(np.float64(0).__reduce__()[0], np.dtype("V100000000"))
    yield "huge number", pickle.dumps(wide)
    yield "endless", b"\x80\x04" + b"(" * 10**6 + b"."
    yield "truncated", pickle.dumps(BySuccess(0.5))[:-9]
    yield "nothing", b""
    yield "text", b"hello"


NAMES = [name for name, _ in pickles("x")]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("key", ["lr_schedule", "_by_success", "observation_space"])
def test_what_a_model_does_not_need_is_refused_in_one_line(saved, tmp_path, name, key):
    marker = tmp_path / "executed"
    path = with_pickle(saved, tmp_path / "hostile.zip", dict(pickles(marker))[name], key)
    with pytest.raises(ValueError, match=key) as refused:
        TD3BC.load(path)
    assert "\n" not in str(refused.value)
    assert not marker.exists()


def test_trusted_files_run_what_they_say(saved, tmp_path):
    """Else the test above could not fail."""
    marker = tmp_path / "executed"
    path = with_pickle(
        saved, tmp_path / "own.zip", dict(pickles(marker))["os.system"], "ep_info_buffer"
    )
    TD3BC.load(path, trust=True)
    assert marker.exists()


def test_the_command_line_has_trust(saved, tmp_path, capsys):
    from regil_sb3.cli import _parser

    assert _parser().parse_args(["evaluate", "run", "--trust"]).trust


@pytest.mark.parametrize("policy", ["CnnPolicy", "MultiInputPolicy"])
def test_own_models_need_no_trust(tmp_path, policy):
    if policy == "CnnPolicy":
        model = small(stacked(), policy_kwargs={"features_extractor_class": "resnet18"})
    else:
        demo = demonstration()
        states = {"x": np.zeros((len(demo), 1), np.float32)}
        from regil_wrappers import Demonstration

        demo = Demonstration(frames=demo.frames, actions=demo.actions, observations=states)
        env = stacked(n_stack=1, dict_obs=True)
        model = small(env, policy, demo=demo, n_steps=1)
    model.learn(30)
    model.ep_success_buffer.append(np.bool_(True))  # as a user's environment may say
    model.save(tmp_path / "model")
    loaded = TD3BC.load(tmp_path / "model")  # without its suffix, as SB3
    assert loaded.num_timesteps == 30
    with (tmp_path / "model.zip").open("rb") as file:
        assert TD3BC.load(file).num_timesteps == 30


def test_damaged_files_are_refused_in_one_line(saved, tmp_path):
    rng = np.random.default_rng(0)
    whole = saved.read_bytes()
    path = tmp_path / "damaged.zip"
    for i in range(60):
        content = bytearray(whole)
        if i % 3 == 0:
            content = content[: rng.integers(0, len(content))]
        else:
            for at in rng.integers(0, len(content), 20):
                content[at] ^= int(rng.integers(1, 256))
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"damaged\.zip") as refused:
            TD3BC.load(path)
        assert "\n" not in str(refused.value)


def test_a_part_that_grows_is_refused(saved, tmp_path):
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", b" " * 50_000_000)
    assert path.stat().st_size < 100_000
    with pytest.raises(ValueError, match="50000000 bytes"):
        TD3BC.load(path)


def test_weights_are_tensors_or_nothing(saved, tmp_path):
    marker, path = tmp_path / "executed", tmp_path / "model.zip"
    hostile = io.BytesIO()
    import torch as th

    th.save({"mu": Call(os.system, f"touch {marker}")}, hostile)
    with zipfile.ZipFile(saved) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            new.writestr(name, hostile.getvalue() if name == "policy.pth" else old.read(name))
    with pytest.raises(ValueError, match=r"model\.zip"):
        TD3BC.load(path)
    assert not marker.exists()


def test_no_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.zip"):
        TD3BC.load(tmp_path / "nowhere")
