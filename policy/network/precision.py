"""The number format of the network's arithmetic."""

from __future__ import annotations

from contextlib import nullcontext
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from contextlib import AbstractContextManager


def autocast(device: torch.device) -> AbstractContextManager[None]:
    """bfloat16 where the processor has instructions for it: faster, to three digits."""
    if device.type == "cuda" or _cpu_has_bfloat16():
        return torch.autocast(device.type, torch.bfloat16)
    return nullcontext()


def _cpu_has_bfloat16() -> bool:
    abilities = torch.cpu.get_capabilities()
    return bool(abilities.get("avx512_bf16") or abilities.get("amx_bf16") or abilities.get("bf16"))
