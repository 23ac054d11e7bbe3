from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from regil_wrappers import Retriever, encoders, make_encoder, register_encoder
from regil_wrappers.encoders import cache, embed, encoder_names, registry, timm_networks

FRAMES = np.random.default_rng(0).integers(0, 256, (6, 84, 96, 3), dtype=np.uint8)


@pytest.fixture(autouse=True)
def fresh_caches(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(registry, "_factories", dict(registry._factories))
    cache._cache.clear()
    make_encoder.cache_clear()
    yield
    cache._cache.clear()
    make_encoder.cache_clear()


class Mean:
    """Average colour; counts how many frames it has encoded."""

    slow = False

    def __init__(self, cache_key: str | None = "mean") -> None:
        self.cache_key = cache_key
        self.encoded = 0

    def encode(self, frames: np.ndarray) -> np.ndarray:
        self.encoded += len(frames)
        return frames.mean(axis=(1, 2)).astype(np.float32)


def test_pixels_is_the_small_picture() -> None:
    embeddings = make_encoder("pixels").encode(FRAMES)
    assert (embeddings.shape, embeddings.dtype) == ((6, 28 * 28 * 3), np.float32)
    small = cv2.resize(FRAMES[2], (28, 28), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(embeddings[2], small.ravel().astype(np.float32) / 255)
    np.testing.assert_array_equal(embeddings[2:3], make_encoder("pixels").encode(FRAMES[2:3]))


def test_unknown_names_list_those_that_exist() -> None:
    with pytest.raises(ValueError, match=r"'pixel'.*'dinov2', 'dinov3', 'pixels', 'timm:<model>'"):
        make_encoder("pixel")


def test_registered_encoders_are_made_once() -> None:
    register_encoder("mean", Mean)
    assert "mean" in encoder_names()
    assert make_encoder("mean") is make_encoder("mean")
    for taken in ("mean", "pixels", "dinov3", "my:own", "my@own"):
        with pytest.raises(ValueError, match=taken):
            register_encoder(taken, Mean)


def test_embeddings_are_cached_by_key_and_frames() -> None:
    encoder = Mean()
    first = embed(encoder, FRAMES)
    assert embed(encoder, FRAMES) is first
    assert embed(Mean(), FRAMES.copy()) is first
    assert encoder.encoded == 6
    changed = FRAMES.copy()
    changed[3, 0, 0, 0] ^= 255
    assert embed(encoder, changed) is not first
    assert embed(Mean("mean, other weights"), FRAMES) is not first
    assert encoder.encoded == 12
    with pytest.raises(ValueError, match="read-only"):
        first[0] = 0


def test_without_a_key_nothing_is_cached() -> None:
    encoder = Mean(cache_key=None)
    embed(encoder, FRAMES)
    embed(encoder, FRAMES)
    assert encoder.encoded == 12


def test_the_cache_forgets_the_oldest() -> None:
    for i in range(20):
        embed(Mean(f"mean {i}"), FRAMES)
    assert len(cache._cache) == cache._CACHED_DEMONSTRATIONS


def test_pixels_needs_no_file(tmp_path: Path) -> None:
    embed(make_encoder("pixels"), FRAMES)
    assert list(tmp_path.iterdir()) == []


def test_slow_encoders_keep_a_file(tmp_path: Path) -> None:
    encoder = Mean()
    encoder.slow = True
    first = embed(encoder, FRAMES)
    (file,) = tmp_path.rglob("*.npz")
    assert file.parent == tmp_path / "regil"
    cache._cache.clear()
    np.testing.assert_array_equal(embed(encoder, FRAMES), first)
    assert encoder.encoded == 6

    # A damaged or foreign file is written again.
    for damage in (b"", b"PK\x03\x04 nothing", file.read_bytes()[:-30]):
        cache._cache.clear()
        file.write_bytes(damage)
        encoder.encoded = 0
        np.testing.assert_array_equal(embed(encoder, FRAMES), first)
        assert encoder.encoded == 6
    cache._cache.clear()
    np.savez(file, embeddings=np.array([{"a": 1}], dtype=object))
    np.testing.assert_array_equal(embed(encoder, FRAMES), first)


def test_a_cache_that_cannot_be_written_costs_only_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    encoder = Mean()
    encoder.slow = True
    assert embed(encoder, FRAMES).shape == (6, 3)


@pytest.mark.parametrize(
    "output",
    [np.zeros((1, 3)), np.zeros(3, np.float32), np.zeros((2, 3), np.float32), [[0.0]]],
    ids=["float64", "one axis", "two rows", "list"],
)
def test_an_encoder_of_another_shape_is_refused(output: object) -> None:
    class Odd:
        def encode(self, frames: np.ndarray) -> object:
            return output

    with pytest.raises(ValueError, match="frame 0 of the demonstration: it must be a float32"):
        embed(Odd(), FRAMES)  # type: ignore[arg-type]


def test_importing_the_package_does_not_import_torch() -> None:
    code = "import sys, regil_wrappers; sys.exit('torch' in sys.modules or 'timm' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_without_torch_or_timm_one_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "timm", None)
    with pytest.raises(ImportError, match=r"pip install 'regil-wrappers\[timm\]'"):
        make_encoder("dinov3")


@pytest.fixture
def checkpoint(tmp_path: Path) -> str:
    """A tiny timm network's weights, written here: no download."""
    try:
        timm, torch = timm_networks._import_timm()
    except ImportError as error:
        pytest.skip(str(error))
    torch.manual_seed(0)
    path = tmp_path / "weights.pth"
    torch.save(timm.create_model("test_vit.r160_in1k", pretrained=False).state_dict(), path)
    return str(path)


def test_timm_from_a_file(checkpoint: str, tmp_path: Path) -> None:
    encoder = make_encoder(f"timm:test_vit.r160_in1k@{checkpoint}")
    assert make_encoder(f"timm:test_vit.r160_in1k@{checkpoint}") is encoder
    assert encoder.frame_size == 160  # type: ignore[attr-defined]
    embeddings = encoder.encode(FRAMES)
    assert (embeddings.shape, embeddings.dtype) == ((6, 64), np.float32)
    np.testing.assert_allclose(np.linalg.norm(embeddings, axis=1), 1, rtol=1e-5)
    assert np.ptp(embeddings, axis=0).max() > 1e-3

    from regil_wrappers import Demonstration

    retriever = Retriever(Demonstration(FRAMES), encoder)
    assert [retriever.step(frame).cost for frame in FRAMES] == [0] * 6
    assert len(list((tmp_path / "regil").glob("*.npz"))) == 1


def test_timm_standardises_by_the_networks_own_numbers(checkpoint: str) -> None:
    encoder = encoders.TimmEncoder("test_vit.r160_in1k", checkpoint, device="cpu")
    torch = encoder._torch
    frame = FRAMES[0, :80, :80]
    big = cv2.resize(frame, (160, 160), interpolation=cv2.INTER_CUBIC)
    x = torch.from_numpy(big).permute(2, 0, 1)[None].float() / 255
    x = (x - 0.5) / 0.5
    with torch.inference_mode():
        y = encoder._network(x)[0].numpy()
    np.testing.assert_allclose(encoder.encode(frame[None])[0], y / np.linalg.norm(y), atol=1e-5)


def test_timm_weights_are_part_of_the_key(checkpoint: str, tmp_path: Path) -> None:
    one = encoders.TimmEncoder("test_vit.r160_in1k", checkpoint)
    timm, torch = timm_networks._import_timm()
    other = tmp_path / "other.pth"
    torch.manual_seed(1)
    torch.save(timm.create_model("test_vit.r160_in1k", pretrained=False).state_dict(), other)
    assert one.cache_key != encoders.TimmEncoder("test_vit.r160_in1k", str(other)).cache_key
    assert one.cache_key == encoders.TimmEncoder("test_vit.r160_in1k", checkpoint).cache_key


def test_timm_bad_names_and_files(checkpoint: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="has no model of that name: did you mean"):
        make_encoder("timm:vit_enormous")
    with pytest.raises(ValueError, match="there is no checkpoint file 'nowhere'"):
        make_encoder("timm:test_vit.r160_in1k@nowhere")
    text = tmp_path / "text.pth"
    text.write_text("not weights")
    with pytest.raises(ValueError, match=r"could not be read from .*text\.pth"):
        make_encoder(f"timm:test_vit.r160_in1k@{text}")


def test_a_missing_download_says_which_file_to_get(
    checkpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    timm, _ = timm_networks._import_timm()

    def offline(*args: object, **kwargs: object) -> None:
        raise ConnectionError("no network\nand a long story")

    monkeypatch.setattr(timm, "create_model", offline)
    with pytest.raises(ValueError, match=r"model\.safetensors from https://\S*dinov3") as caught:
        make_encoder("dinov3")
    assert "\n" not in str(caught.value)
