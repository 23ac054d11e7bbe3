"""Recording the scripted expert."""

import gymnasium as gym
import numpy as np
import pytest
from regil_wrappers.demonstration import Demonstration
from stable_baselines3.common.vec_env import DummyVecEnv, VecTransposeImage

from regil_sb3.as_seen import as_seen
from regil_sb3.recording import EVALUATION_SEEDS, Recorder, record_expert

BUTTON = "regil/metaworld-button-press-v0"


class Patient(gym.Env):
    """Solved after three steps, if the seed is at least 3; its expert asks for too much."""

    observation_space = gym.spaces.Box(0, 255, (8, 8, 3), np.uint8)
    action_space = gym.spaces.Box(-0.5, 0.5, (2,), np.float32)
    asked = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seed, self.now = seed, 0
        return np.zeros((8, 8, 3), np.uint8), {}

    def step(self, action):
        assert action in self.action_space
        self.now += 1
        solved = self.now == 3 and self.seed >= 3
        frame = np.full((8, 8, 3), self.now, np.uint8)
        return frame, 0.0, False, self.now == 5, {"is_success": solved}

    def expert_action(self):
        Patient.asked += 1
        return np.array([9, -0.25], np.float32)


@pytest.fixture
def patient():
    gym.register("Patient-v0", Patient)
    Patient.asked = 0
    yield "Patient-v0"
    del gym.registry["Patient-v0"]


def test_recording_ends_with_the_frame_after_the_first_success(patient):
    lines = []
    demo = record_expert(patient, seed=1, progress=lines.append)
    assert demo.frames[:, 0, 0, 0].tolist() == [0, 1, 2, 3]
    assert demo.actions.tolist() == [[0.5, -0.25]] * 3
    assert demo.successes.tolist() == [False, False, False, True]
    assert demo.observations is None
    assert demo.encoder_frames is None
    assert (demo.metadata["seed"], demo.metadata["seeds_tried"]) == (3, 3)
    assert Patient.asked == 5 + 5 + 3  # once per agent step
    assert lines == [
        "seed 1: not solved after 5 steps",
        "seed 2: not solved after 5 steps",
        "seed 3: solved after 3 steps",
    ]


def test_no_success_gets_one_line(patient):
    with pytest.raises(ValueError, match="solved none of the seeds 0 to 2") as caught:
        record_expert(patient, max_seeds=3)
    assert "\n" not in str(caught.value)


def test_replaying_the_recording_gives_its_frames_and_its_success(tmp_path):
    record_expert(BUTTON, seed=4, encoder_frame_size=112).save(tmp_path / "demo.hdf5")
    demo = Demonstration.load(tmp_path / "demo.hdf5")
    assert demo.encoder_frames.shape == (len(demo), 112, 112, 3)
    env = gym.make(BUTTON)
    frames = [env.reset(seed=demo.metadata["seed"])[0]]
    for action in demo.actions:
        frame, _, terminated, _, _ = env.step(action)
        frames.append(frame)
    assert np.array_equal(frames, demo.frames)
    assert np.array_equal(env.unwrapped.encoder_frame(112), demo.encoder_frames[-1])
    assert terminated
    env.close()


def test_metadata_says_how_it_was_recorded():
    demo = record_expert(BUTTON, env_kwargs={"size": 32, "camera": "corner-near"})
    metadata = demo.metadata
    env = gym.make(BUTTON, size=32, camera="corner-near")
    ours = env.unwrapped.metadata["regil"]
    env.close()
    for name in ("camera", "render", "image_size", "action_repeat", "control_rate"):
        assert metadata[name] == ours[name], name
    assert metadata["env_id"] == BUTTON
    assert (metadata["action_low"], metadata["action_high"]) == ([-1.0] * 4, [1.0] * 4)
    assert {"metaworld", "mujoco", "regil-sb3", "gymnasium", "numpy"} <= set(metadata["versions"])


def test_state_is_kept_beside_pictures_of_it():
    demo = record_expert(BUTTON, env_kwargs={"obs": "state", "size": 32})
    pixels = record_expert(BUTTON, env_kwargs={"size": 32})
    assert demo.observations.shape == (len(demo), 39)
    assert np.array_equal(demo.frames, pixels.frames)


class TwoCameras(Patient):
    """Its observations are written into the same arrays at every step."""

    observation_space = gym.spaces.Dict(
        {
            "front": Patient.observation_space,
            "state": gym.spaces.Box(0, 9, (1,), np.float32),
            "wrist": Patient.observation_space,
        }
    )
    held = {name: space.sample() for name, space in observation_space.items()}  # noqa: RUF012

    def seen(self, frame):
        self.held["front"][:], self.held["wrist"][:] = frame, frame + 100
        self.held["state"][:] = self.now
        return self.held

    def reset(self, *, seed=None, options=None):
        frame, info = super().reset(seed=seed)
        return self.seen(frame), info

    def step(self, action):
        frame, *rest = super().step(action)
        return self.seen(frame), *rest


def test_every_camera_is_kept_and_cloned(tmp_path):
    recorder = Recorder(TwoCameras())
    recorder.begin(3)
    while not recorder.over:
        recorder.step(np.zeros(2, np.float32))
    recorder.demonstration("TwoCameras-v0").save(tmp_path / "demo.hdf5")
    demo = Demonstration.load(tmp_path / "demo.hdf5")
    assert demo.frames[:, 0, 0, 0].tolist() == [0, 1, 2, 3]
    assert sorted(demo.observations) == ["state", "wrist"]
    assert demo.observations["wrist"][:, 0, 0, 0].tolist() == [100, 101, 102, 103]

    space = VecTransposeImage(DummyVecEnv([TwoCameras])).observation_space
    seen, actions = as_seen(demo, space, TwoCameras.action_space, 1)
    assert {k: v.shape for k, v in seen.items()} == {k: (3, *v.shape) for k, v in space.items()}
    assert seen["front"][:, 0, 0, 0].tolist() == [0, 1, 2]
    assert seen["wrist"][:, 0, 0, 0].tolist() == [100, 101, 102]
    assert seen["state"][:, 0].tolist() == [0, 1, 2]
    assert actions.shape == (3, 2)


def test_frames_are_one_picture_and_no_more():
    """Of one that is the only observation; not of two, nor of what is no picture."""
    frames = np.zeros((3, 8, 8, 3), np.uint8)
    demo = Demonstration(frames, actions=np.zeros((2, 2), np.float32))
    front, state, wrist = TwoCameras.observation_space.spaces.values()
    seen, _ = as_seen(demo, gym.spaces.Dict(front=front), TwoCameras.action_space, 1)
    assert np.array_equal(seen["front"], frames[:2])
    with_state = Demonstration(frames, demo.actions, {"x": np.zeros((3, 1), np.float32)})
    both = gym.spaces.Dict(x=state, front=front, wrist=wrist)
    with pytest.raises(ValueError, match="lack front, wrist"):
        as_seen(with_state, both, TwoCameras.action_space, 1)
    with pytest.raises(ValueError, match="lack state"):
        as_seen(with_state, gym.spaces.Dict(x=state, state=state), TwoCameras.action_space, 1)


def test_pictures_of_no_declared_size_get_one_line():
    class Draws(Patient):
        observation_space = gym.spaces.Box(0, 9, (1,), np.float32)

        def encoder_frame(self, size):
            return np.zeros((size, size, 3), np.uint8)

    for own in ({}, {"regil": {"camera": "front"}}):
        Draws.metadata = own
        with pytest.raises(ValueError, match=r"^Draws draws its pictures .*image_size"):
            Recorder(Draws())
    Draws.metadata = {"regil": {"image_size": [8, 8]}}
    recorder = Recorder(Draws())
    recorder.begin(0)
    assert recorder.frames[0].shape == (8, 8, 3)


def test_limits_that_are_not_finite_are_unknown():
    env = Patient()
    env.action_space = gym.spaces.Box(-1, np.inf, (2,), np.float32)
    recorder = Recorder(env)
    recorder.begin(3)
    recorder.step(np.array([-3, 3], np.float32))
    demo = recorder.demonstration("Patient-v0")
    assert demo.actions.tolist() == [[-1, 3]]
    assert demo.metadata["action_low"] == [-1, -1]
    assert demo.metadata["action_high"] is None


def test_environment_without_an_expert_gets_one_line():
    with pytest.raises(ValueError, match=r"^Pendulum-v1 has no scripted expert"):
        record_expert("Pendulum-v1")


@pytest.mark.parametrize("seed", [-1, EVALUATION_SEEDS - 19, 2 * EVALUATION_SEEDS])
def test_evaluation_seeds_are_refused(seed):
    with pytest.raises(ValueError, match="kept for evaluation"):
        record_expert(BUTTON, seed=seed)


def test_last_training_seed_is_allowed(patient):
    assert record_expert(patient, seed=EVALUATION_SEEDS - 20).metadata["seed"] == 999_980
