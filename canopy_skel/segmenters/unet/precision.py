"""Whether bfloat16 pays on this machine."""

import torch


def has_fast_bfloat16() -> bool:
    """Say whether the CPU multiplies bfloat16 in hardware (AMX, AVX-512 BF16).

    Elsewhere it is emulated, up to hundreds of times slower than float32
    (pytorch issues 118499, 146508).
    """
    cpu = torch.cpu
    return bool(cpu._is_amx_tile_supported() or cpu._is_avx512_bf16_supported())  # noqa: SLF001
