"""The smallest few entries of each column, by a sorting network.

PyTorch's sort takes tens of microseconds a car here. A network of minima and maxima is the same few operations for all
columns at once, whatever is in them.
"""

from __future__ import annotations

import torch
from torch import Tensor

_BITS = {torch.float32: torch.int32, torch.float64: torch.int64}
_BEHIND = 1e12


def smallest(values: Tensor, wanted: Tensor, kept: int) -> Tensor:
    """Where the smallest wanted entries of each column are, smallest first.

    Non-negative floating-point numbers order like the integers that their bits spell, so each entry's row is put in
    place of its lowest bits and the network moves one integer instead of two numbers. Entries that agree but for those
    bits (for 64 rows, a relative difference of 8e-6 in float32) count as equal, and of equal ones the upper row comes
    first.

    Args:
        values: [N, *batch], from 0 to 1e12.
        wanted: [N, *batch], 1 or 0.
        kept: how many to return, at most N.

    Returns:
        Rows, [kept, *batch] int32 (int64 for float64). Where fewer are wanted, the others follow in no order.
    """
    wires = 1 << max(1, (len(values) - 1).bit_length())
    batch = values.shape[1:]
    integer = _BITS[values.dtype]
    rows = torch.arange(len(values), dtype=integer, device=values.device).view(-1, *[1] * len(batch))
    keys = torch.add(values, 1 - wanted, alpha=_BEHIND).view(integer).bitwise_and_(-wires).bitwise_or_(rows)
    if wires > len(values):
        keys = torch.cat([keys, keys.new_full((wires - len(values), *batch), torch.iinfo(integer).max)])
    return _sorted(keys.view(wires, -1), kept)[:kept].view(kept, *batch).bitwise_and_(wires - 1)


def _sorted(keys: Tensor, kept: int) -> Tensor:
    """Sort each column of [wires, N] by Batcher's bitonic merges; rows beyond the first `kept` may be missing.

    Two neighbouring sorted runs become one by comparing the first with the reversed second, which parts them into a
    smaller and a larger half, and by parting each half likewise down to single wires. A larger half that lies beyond
    `kept` is dropped.
    """
    if kept == 1:
        return keys.amin(0, keepdim=True)
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
    return keys


def _parted(first: Tensor, second: Tensor) -> Tensor:
    """The smaller ones of two [runs, wires, N], then the larger ones, run by run: [runs * 2 * wires, N]."""
    runs, wires, columns = first.shape
    both = first.new_empty(runs, 2, wires, columns)
    torch.minimum(first, second, out=both[:, 0])
    torch.maximum(first, second, out=both[:, 1])
    return both.view(-1, columns)
