import copy
import functools
import hashlib
import json
import pickle

import pytest
import safetensors.torch
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from policy.network.registry import make_network
from policy.network.weights import NAMED, load_named, load_weights, save_weights
from robotcell.errors import ConfigError, StorageError

CARD = {"training": json.dumps({"steps": 5000, "lr": 1e-3}), "evaluation": json.dumps({"grasp": 0.94})}


@functools.cache
def trained(architecture="fast", seed=0):
    """A network with norm statistics that are not those of a fresh one."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = make_network(architecture)
        for name, buffer in network.named_buffers():
            if buffer.is_floating_point():
                buffer.copy_(torch.rand(buffer.shape) + (0.5 if name.endswith("var") else -0.5))
            else:
                buffer.fill_(7)
    return network


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "good.safetensors"
    save_weights(path, trained(), "fast", CARD)
    return path


@pytest.fixture(scope="module")
def scratch(tmp_path_factory):
    return tmp_path_factory.mktemp("damaged") / "damaged.safetensors"


def refused(path, match=None):
    with pytest.raises(ConfigError, match=match) as refusal:
        load_weights(path)
    assert str(path) in str(refusal.value)


def digest(tensors, metadata):
    """The SHA-256 of a weights file, as the rules of its format have it."""
    found = hashlib.sha256(json.dumps(sorted(metadata.items())).encode())
    for name, tensor in sorted(tensors.items()):
        found.update(json.dumps([name, str(tensor.dtype), list(tensor.shape)]).encode())
        found.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return found.hexdigest()


def rewrite(good, to, tensors=None, **metadata):
    """A file that is whole as far as safetensors goes, with some tensors and entries replaced."""
    with safetensors.safe_open(good, framework="pt") as file:
        entries = file.metadata() | metadata
    safetensors.torch.save_file(tensors or safetensors.torch.load_file(good), to, entries)
    return to


def test_what_was_saved_is_what_is_loaded(good):
    network, metadata = load_weights(good)
    saved, loaded = trained().state_dict(), network.state_dict()
    assert list(loaded) == list(saved)
    for name, tensor in saved.items():
        assert loaded[name].dtype == tensor.dtype
        assert torch.equal(loaded[name], tensor)
    assert not network.training
    assert metadata.items() >= {"architecture": "fast", "format": "1", **CARD}.items()
    x = torch.rand(1, 5, 32, 32, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        assert torch.equal(network(x), trained().eval()(x))


def test_a_loaded_network_can_be_trained_further(good):
    network, _ = load_weights(good)
    network.train()(torch.rand(2, 5, 16, 16)).sum().backward()
    assert all(p.requires_grad and p.grad is not None for p in network.parameters())


def test_loading_draws_no_random_number(good):
    state = torch.get_rng_state()
    load_weights(good)
    assert torch.equal(torch.get_rng_state(), state)


def test_the_fast_network_is_small_enough_for_a_repository(good):
    assert good.stat().st_size < 8_000_000


def test_a_large_network_is_rounded_to_half_and_loaded_as_float32(tmp_path):
    path, network = tmp_path / "paper.safetensors", trained("paper")
    save_weights(path, network, "paper", {})
    assert path.stat().st_size < 40_000_000
    loaded, _ = load_weights(path)
    for saved, tensor in zip(network.state_dict().values(), loaded.state_dict().values(), strict=True):
        assert tensor.dtype == saved.dtype
        assert torch.equal(tensor, saved.half().float() if saved.ndim >= 2 else saved)


@settings(max_examples=15)
@given(
    card=st.dictionaries(
        st.text(min_size=1).filter(lambda name: name not in {"format", "architecture", "resolution_m", "sha256"}),
        st.text(),
        max_size=4,
    )
)
def test_a_card_may_say_anything(scratch, card):
    save_weights(scratch, trained(), "fast", card)
    _, metadata = load_weights(scratch)
    assert {name: metadata[name] for name in card} == card


@settings(max_examples=40)
@given(data=st.data())
def test_a_file_that_was_cut_short_is_refused(good, scratch, data):
    content = good.read_bytes()
    end = data.draw(st.one_of(st.integers(0, 12_000), st.integers(0, len(content) - 1)))
    scratch.write_bytes(content[:end])
    refused(scratch, "no whole safetensors file .* fetch or save it again")


@settings(max_examples=150)
@given(data=st.data())
def test_a_file_with_a_flipped_bit_is_refused(good, scratch, data):
    content = bytearray(good.read_bytes())
    header = 8 + int.from_bytes(content[:8], "little")
    byte = data.draw(st.one_of(st.integers(0, 8), st.integers(0, header), st.integers(0, len(content) - 1)))
    content[byte] ^= 1 << data.draw(st.integers(0, 7))
    scratch.write_bytes(content)
    refused(scratch)


def test_a_changed_card_is_refused(good, scratch):
    refused(rewrite(good, scratch, evaluation=json.dumps({"grasp": 0.99})), "damaged.*SHA-256; fetch or save")


def test_another_format_is_refused(good, scratch):
    refused(rewrite(good, scratch, resolution_m="0.001"), "trained on cells of 0.001 m")
    refused(rewrite(good, scratch, format="2"), "of format '2'; this program reads format '1'")


def test_weights_of_another_program_are_refused(scratch):
    safetensors.torch.save_file({"weight": torch.zeros(3)}, scratch)
    refused(scratch, "without a format: not written by us")


def test_an_unknown_architecture_is_refused(good, scratch):
    refused(rewrite(good, scratch, architecture="deep"), "no network is called 'deep'; there is: fast, paper")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: {k: v for k, v in t.items() if k != "stem.0.0.weight"}, "stem.0.0.weight is missing"),
        (lambda t: t | {"extra": torch.zeros(2)}, "extra is not known"),
        (lambda t: t | {"stem.0.1.bias": torch.zeros(5)}, r"stem.0.1.bias is \(5,\) instead of \(32,\)"),
        (lambda t: t | {"stem.0.1.bias": torch.zeros(32).long()}, "stem.0.1.bias is torch.int64 instead of"),
        (lambda t: t | {"stem.0.1.bias": torch.zeros(32).to(torch.float8_e5m2)}, "stem.0.1.bias is torch.float8_e5m2"),
    ],
)
def test_tensors_that_do_not_fit_are_refused(good, scratch, change, message):
    tensors = change(safetensors.torch.load_file(good))
    refused(rewrite(good, scratch, tensors), f"1 tensors do not fit the network .{message}.*save it again")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_values_that_are_not_finite_are_neither_saved_nor_loaded(good, scratch, value):
    network = copy.deepcopy(trained())
    network.stem[0][1].running_var[3] = value
    with pytest.raises(ConfigError, match=r"not finite in stem\.0\.1\.running_var; the training diverged"):
        save_weights(scratch.with_name("never"), network, "fast", {})
    assert not scratch.with_name("never").exists()
    with safetensors.safe_open(good, framework="pt") as file:
        entries = {name: text for name, text in file.metadata().items() if name != "sha256"}
    tensors = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    rewrite(good, scratch, tensors, sha256=digest(tensors, entries))
    refused(scratch, "not finite in stem.0.1.running_var")


def test_what_is_no_weights_file_is_refused_and_not_run(tmp_path):
    class Trap:
        def __reduce__(self):
            return (tmp_path.joinpath("sprung").touch, ())

    path = tmp_path / "weights.safetensors"
    refused(path, r"no such file; name one that exists")
    refused(tmp_path, "cannot be read")
    for content in (b"", b"hello", b"\xff" * 100, pickle.dumps(Trap()), b"\x02\0\0\0\0\0\0\0{}" + b"x"):
        path.write_bytes(content)
        refused(path, "no whole safetensors file")
    path.write_bytes(b"\x02\0\0\0\0\0\0\0{}")
    refused(path, "without a format")
    assert not (tmp_path / "sprung").exists()


def test_a_network_is_only_saved_as_what_it_is(tmp_path):
    path = tmp_path / "weights.safetensors"
    with pytest.raises(ConfigError, match=r"do not fit the network .*; name the architecture that the network has"):
        save_weights(path, trained(), "paper", {})
    with pytest.raises(ConfigError, match="no network is called 'deep'"):
        save_weights(path, trained(), "deep", {})
    with pytest.raises(ConfigError, match="needs the entries format, sha256; rename"):
        save_weights(path, trained(), "fast", {"sha256": "0", "format": "mine"})
    with pytest.raises(StorageError, match=r"cannot be written: No such file or directory; check the folder"):
        save_weights(tmp_path / "nowhere" / "weights.safetensors", trained(), "fast", {})
    assert list(tmp_path.iterdir()) == []


def test_saving_again_replaces_the_file(tmp_path):
    path = tmp_path / "weights.safetensors"
    save_weights(path, trained(seed=1), "fast", {})
    save_weights(path, trained(seed=2), "fast", {})
    network, _ = load_weights(path)
    assert torch.equal(network.state_dict()["stem.0.0.weight"], trained(seed=2).state_dict()["stem.0.0.weight"])
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("name", NAMED)
def test_weights_of_the_package_go_by_name(tmp_path, name):
    with pytest.raises(
        ConfigError, match=f"'{name}' are not part of this installation .policy/data/{name}.safetensors"
    ):
        load_named(name, tmp_path)
    save_weights(tmp_path / f"{name}.safetensors", trained(), "fast", CARD)
    assert load_named(name, tmp_path)[1]["evaluation"] == CARD["evaluation"]


def test_unknown_weights_list_those_that_exist():
    with pytest.raises(ConfigError, match="no weights are called 'best'; there is: learned, single-stage"):
        load_named("best")
