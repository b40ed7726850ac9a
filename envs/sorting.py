"""The smallest few entries of each column.

PyTorch picks them column by column, which takes it up to a microsecond each. A network of minima and maxima is the same
operations for all columns at once, whatever is in them: dozens of them, which pays where columns are many.
"""

from __future__ import annotations

import torch
from torch import Tensor

from coil_rl.envs.constants import constant

_BITS = {torch.float32: torch.int32, torch.float64: torch.int64}
_BEHIND = 1e12
_FEW = 16_384  # entries, up to which the network is the slower way


def smallest(values: Tensor, unwanted: Tensor, kept: int) -> Tensor:
    """Where the smallest wanted entries of each column are, smallest first.

    Non-negative floating-point numbers order like the integers that their bits spell, so each entry's row is put in
    place of its lowest bits and the network moves one integer instead of two numbers. Entries that agree but for those
    bits (for 64 rows, a relative difference of 8e-6 in float32) count as equal, and of equal ones the upper row comes
    first.

    Args:
        values: [N, *batch], from 0 to 1e12.
        unwanted: [N, *batch], 1 or 0.
        kept: how many to return, at most N.

    Returns:
        Rows, [kept, *batch] int32 (int64 for float64). Where fewer are wanted, the others follow in no order.
    """
    wires = 1 << max(1, (len(values) - 1).bit_length())
    integer = _BITS[values.dtype]
    rows = constant(range(len(values)), values, integer)
    keys = torch.add(values, unwanted, alpha=_BEHIND).view(integer)
    keys = keys.bitwise_and_(constant(-wires, rows)).bitwise_or_(rows)
    if kept == 1:
        first = keys.amin(0, keepdim=True)
    elif keys.device.type == "cpu" and keys.numel() <= _FEW and not torch.compiler.is_compiling():
        first = keys.topk(kept, 0, largest=False).values
    else:
        first = _sorted(keys, wires, kept)
    return first.bitwise_and_(constant(wires - 1, rows))


def _sorted(keys: Tensor, wires: int, kept: int) -> Tensor:
    """The first `kept` rows of [N, *batch] sorted by Batcher's bitonic merges of `wires` rows, a power of two.

    Two neighbouring sorted runs become one by comparing the first with the reversed second, which parts them into a
    smaller and a larger half, and by parting each half likewise down to single wires. A larger half that lies beyond
    `kept` is dropped.
    """
    batch = keys.shape[1:]
    if wires > len(keys):
        keys = torch.cat([keys, keys.new_full((wires - len(keys), *batch), torch.iinfo(keys.dtype).max)])
    keys = keys.view(wires, -1)
    run = 1
    while run < len(keys):
        first, second = keys.view(-1, 2, run, keys.shape[1]).unbind(1)
        part = run // 2
        if run < kept:
            keys = _parted(first, second.flip(1))
            run *= 2
        else:
            keys = torch.minimum(first, second.flip(1)).flatten(0, 1)
        while part:
            keys = _parted(*keys.view(-1, 2, part, keys.shape[1]).unbind(1))
            part //= 2
    return keys[:kept].view(kept, *batch)


def _parted(first: Tensor, second: Tensor) -> Tensor:
    """The smaller ones of two [runs, wires, N], then the larger ones, run by run: [runs * 2 * wires, N]."""
    runs, wires, columns = first.shape
    both = first.new_empty(runs, 2, wires, columns)
    torch.minimum(first, second, out=both[:, 0])
    torch.maximum(first, second, out=both[:, 1])
    return both.view(-1, columns)
