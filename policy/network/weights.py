"""Trained weights as safetensors files: what they are of, how they came about, and whether they are whole.

The metadata of a file are strings: `format`, the version of these rules; `architecture`, a name of
`policy.network.registry.NETWORKS`; `resolution_m`, the size of the cells that it was trained on (`RESOLUTION_M` where
the entry is missing); `sha256` over all else in the file; and the card, free entries of whoever wrote it,
such as the training configuration and the evaluation as JSON.
"""

from __future__ import annotations

import hashlib
import json
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np
import safetensors.torch
import torch

from policy.network.encoding import RESOLUTION_M
from policy.network.registry import make_network
from robotcell.errors import ConfigError
from robotcell.io.atomic_file import replaced
from robotcell.io.input_file import read_bytes

if TYPE_CHECKING:
    from collections.abc import Mapping
    from importlib.abc import Traversable
    from pathlib import Path

    from torch import Tensor, nn

# Weights that come with the package.
NAMED = ("learned", "single-stage")

_FORMAT = "1"
_RESERVED = {"format", "architecture", "resolution_m", "sha256"}
# A file that would be larger holds its convolutions as float16.
_LARGE_BYTES = 8_000_000
# The paper's network, the largest of all, takes 74 MB as float32.
_MAX_BYTES = 256_000_000


def save_weights(path: Path, network: nn.Module, architecture: str, card: Mapping[str, str]) -> None:
    """Write a network's weights, norm statistics included; a file of that name is replaced in one step.

    They are stored as they are, float32, so that loading gives the same network to the last bit. Where that would take
    more than 8 MB, tensors of two and more dimensions are rounded to float16.

    Args:
        path: of the file; its folder must exist.
        network: on any device.
        architecture: the network's name in `policy.network.registry.NETWORKS`.
        card: further entries of the metadata.

    Raises:
        ConfigError: the card uses a reserved name, the network is not of that architecture or has values that are not
            finite.
        StorageError: the file cannot be written.
    """
    what = f"weights for {path}"
    taken = sorted(card.keys() & _RESERVED)
    if taken:
        raise ConfigError(f"{what}: the file itself needs the entries {', '.join(taken)}; rename those of the card")
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    _check_fit(tensors, _blank(architecture, what), what, "name the architecture that the network has")
    if sum(tensor.nbytes for tensor in tensors.values()) > _LARGE_BYTES:
        tensors = {name: tensor.half() if tensor.ndim >= 2 else tensor for name, tensor in tensors.items()}
    _check_finite(tensors, what, "the training diverged, go back to an earlier state")
    metadata = {**card, "format": _FORMAT, "architecture": architecture, "resolution_m": str(RESOLUTION_M)}
    content = safetensors.torch.save(tensors, {**metadata, "sha256": _digest(tensors, metadata)})
    with replaced(path) as part:
        part.write_bytes(content)


def load_weights(path: Path) -> tuple[nn.Module, dict[str, str]]:
    """The network, in eval mode on the CPU as float32, and the file's metadata.

    Raises:
        ConfigError: the file cannot be read, is not one of ours, is damaged, or does not fit this program's network.
    """
    what = f"weights {path}"
    tensors, metadata = _read(path, what)
    if metadata.get("format") != _FORMAT:
        found = f"of format {metadata['format']!r}" if "format" in metadata else "without a format: not written by us"
        raise ConfigError(f"{what}: {found}; this program reads format {_FORMAT!r}, save them again with it")
    if metadata.get("resolution_m", str(RESOLUTION_M)) != str(RESOLUTION_M):
        raise ConfigError(
            f"{what}: trained on cells of {metadata['resolution_m']} m, and this program shows networks cells of "
            f"{RESOLUTION_M} m; choose other weights, or train again"
        )
    network = _blank(metadata.get("architecture", ""), what)
    _check_fit(tensors, network, what, "fetch the file again, or save it again with this version of the program")
    sealed = {name: value for name, value in metadata.items() if name != "sha256"}
    if metadata.get("sha256") != _digest(tensors, sealed):
        raise ConfigError(f"{what}: damaged, the content does not match its SHA-256; fetch or save the file again")
    _check_finite(tensors, what, "take those of an earlier state of the training")
    expected = network.state_dict()
    network.load_state_dict({name: tensor.to(expected[name].dtype) for name, tensor in tensors.items()}, assign=True)
    return network.eval(), metadata


def load_named(name: str, folder: Traversable | None = None) -> tuple[nn.Module, dict[str, str]]:
    """What `load_weights` gives, of the weights of that name that come with the package.

    Args:
        name: one of `NAMED`.
        folder: of the weights files; None for that of the package.

    Raises:
        ConfigError: there are none, or the file is not as it should be.
    """
    if name not in NAMED:
        raise ConfigError(f"no weights are called {name!r}; there is: {', '.join(NAMED)}")
    source = (folder or resources.files("policy") / "data") / f"{name}.safetensors"
    if not source.is_file():
        raise ConfigError(
            f"the weights {name!r} are not part of this installation (policy/data/{name}.safetensors is missing); "
            "train them, install the package again, or choose a policy that needs none"
        )
    with resources.as_file(source) as path:
        return load_weights(path)


def _read(path: Path, what: str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of any safetensors file."""
    content = read_bytes(path, _MAX_BYTES, "name one that exists, or train one")
    try:
        tensors = safetensors.torch.load(content)
        # The header is JSON after its length in eight bytes; the reader of bytes gives only the tensors.
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    except Exception as error:
        # The reader raises its own errors and, for a header that makes no sense, various others.
        raise ConfigError(f"{what}: no whole safetensors file ({error}); fetch or save it again") from error
    return tensors, header.get("__metadata__") or {}


def _digest(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    """SHA-256 over the entries of the metadata and the name, type, shape and bytes of each tensor, all sorted."""
    digest = hashlib.sha256(json.dumps(sorted(metadata.items())).encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(json.dumps([name, str(tensor.dtype), list(tensor.shape)]).encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def _blank(architecture: str, what: str) -> nn.Module:
    """The network without memory for its weights: nothing is initialised, and no random number drawn."""
    try:
        with torch.device("meta"):
            return make_network(architecture)
    except ConfigError as error:
        raise ConfigError(f"{what}: {error}") from error


def _check_fit(tensors: Mapping[str, Tensor], network: nn.Module, what: str, remedy: str) -> None:
    """Every tensor of the network must be there in its shape, and no other."""
    expected = network.state_dict()
    odd = [f"{name} is missing" for name in expected if name not in tensors]
    odd += [f"{name} is not known" for name in tensors if name not in expected]
    for name in expected.keys() & tensors.keys():
        has, needs = tensors[name], expected[name]
        if has.shape != needs.shape:
            odd.append(f"{name} is {tuple(has.shape)} instead of {tuple(needs.shape)}")
        elif has.dtype != needs.dtype and (has.dtype, needs.dtype) != (torch.float16, torch.float32):
            odd.append(f"{name} is {has.dtype} instead of {needs.dtype}")
    if odd:
        raise ConfigError(f"{what}: {len(odd)} tensors do not fit the network ({', '.join(sorted(odd)[:3])}); {remedy}")


def _check_finite(tensors: Mapping[str, Tensor], what: str, remedy: str) -> None:
    """No weight and no statistic may be NaN or infinite."""
    odd = sorted(name for name, tensor in tensors.items() if not np.isfinite(tensor.numpy()).all())
    if odd:
        raise ConfigError(f"{what}: values that are not finite in {', '.join(odd[:3])}; {remedy}")
