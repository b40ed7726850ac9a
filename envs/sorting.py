"""Batched selection: the smallest entries, entries without a conflict, and lists that grow.

The cone world and the spline guides choose among candidates in every step: the nearest visible
cones, the nearest midpoints, the targets that are far enough apart. All functions here do that for
every column of a batch at once, without a branch on the data.

`Tensor.topk` processes one column after another, up to a microsecond each. A sorting network of
minima and maxima applies a few dozen operations to all columns at once, which is faster for many
columns.
"""

import torch
from torch import Tensor

from coil_rl.envs.constants import constant

_BITS = {torch.float32: torch.int32, torch.float64: torch.int64}
_MASKED = 1e12
_TOPK_LIMIT = 16_384  # entries; up to this size `topk` is faster than the network


def smallest(values: Tensor, masked: Tensor, k: int) -> Tensor:
    """Return the rows of the k smallest unmasked entries of each column, smallest first.

    Non-negative floats order like the integers with the same bits. The lowest bits of each entry
    are replaced by its row, so entries that differ in those bits only (for 64 rows, 8e-6 in
    float32) count as equal and keep their order.

    Args:
        values: [N, *batch], from 0 to 1e12.
        masked: [N, *batch], 1 for entries to skip, else 0.
        k: number of rows to return, at most N: [k, *batch], int32 (int64 for float64). Masked
            entries fill up columns with fewer, in any order.
    """
    if torch.compiler.is_exporting():  # ONNX cannot read a float as an integer
        keys = torch.add(values, masked, alpha=_MASKED)
        return keys.topk(k, 0, largest=False).indices.to(_BITS[values.dtype])
    rows_padded = 1 << max(1, (len(values) - 1).bit_length())
    integer = _BITS[values.dtype]
    rows = constant(range(len(values)), values, integer)
    keys = torch.add(values, masked, alpha=_MASKED).view(integer)
    keys = keys.bitwise_and_(constant(-rows_padded, rows)).bitwise_or_(rows)
    if k == 1:
        first = keys.amin(0, keepdim=True)
    elif (
        keys.device.type == "cpu"
        and keys.numel() <= _TOPK_LIMIT
        and not torch.compiler.is_compiling()
    ):
        first = keys.topk(k, 0, largest=False).values
    else:
        first = _bitonic_sort(keys, k)
    return first.bitwise_and_(constant(rows_padded - 1, rows))


def _bitonic_sort(keys: Tensor, k: int) -> Tensor:
    """Return the first k rows of keys [N, *batch], sorted by Batcher's bitonic network.

    A pair of sorted runs is merged by comparing the first run with the reversed second one, which
    separates the smaller from the larger half, and by splitting each half in the same way down to
    single rows. Runs grow to the power of two that holds k rows; from then on rows beyond it are
    dropped, and the last run of an odd number waits for the next round.
    """
    batch, longest = keys.shape[1:], 1 << (k - 1).bit_length()
    padding = -len(keys) % longest
    if padding:
        largest = torch.iinfo(keys.dtype).max
        keys = torch.cat([keys, keys.new_full((padding, *batch), largest)])
    keys = keys.view(len(keys), -1)
    run = 1
    while run < len(keys):
        half, waiting = run // 2, None
        if len(keys) // run % 2:
            keys, waiting = keys[:-run], keys[-run:]
        first, second = keys.view(-1, 2, run, keys.shape[1]).unbind(1)
        if run < k:
            keys = _compare(first, second.flip(1))
            run *= 2
        else:
            keys = torch.minimum(first, second.flip(1)).flatten(0, 1)
        while half:
            keys = _compare(*keys.view(-1, 2, half, keys.shape[1]).unbind(1))
            half //= 2
        if waiting is not None:
            keys = torch.cat([keys, waiting])
    return keys[:k].view(k, *batch)


def _compare(first: Tensor, second: Tensor) -> Tensor:
    """Return minima followed by maxima of two [runs, rows, N], run by run: [runs * 2 * rows, N]."""
    runs, rows, columns = first.shape
    both = first.new_empty(runs, 2, rows, columns)
    torch.minimum(first, second, out=both[:, 0])
    torch.maximum(first, second, out=both[:, 1])
    return both.view(-1, columns)


def first_come(eligible: Tensor, conflict: Tensor) -> Tensor:
    """Select each eligible entry that is in conflict with no selected one before it.

    Args:
        eligible: [N, *batch], bool.
        conflict: [N, N, *batch], bool and symmetric, whether two entries exclude each other.

    Returns:
        Whether each entry is selected, [N, *batch].
    """
    selected = list(eligible.unbind(0))
    for i in range(1, len(selected)):
        selected[i] = selected[i] & ~(torch.stack(selected[:i]) & conflict[i, :i]).any(0)
    return torch.stack(selected)


def append(points: Tensor, count: Tensor, more: Tensor, selected: Tensor) -> tuple[Tensor, Tensor]:
    """Append selected points to lists of points, in order, as far as there is room.

    Args:
        points: the lists, [D, N, *batch].
        count: [*batch], integers, number of points of each list that are in use.
        more: the points to choose from, [D, M, *batch].
        selected: [M, *batch], bool, which of them to append.

    Returns:
        The new lists and their counts.
    """
    room = points.shape[1]
    slot = torch.where(selected, count + selected.cumsum(0) - 1, room).clamp_(max=room)
    longer = torch.cat([points, points[:, :1]], 1).scatter_(1, slot.expand_as(more), more)
    return longer[:, :room], (count + selected.sum(0)).clamp_(max=room)


def rows_in_use(mask: Tensor) -> Tensor:
    """Return the rows to compute for a mask [B]: those in it, or all where reading it is expensive.

    On a CPU reading the mask is cheap. On a GPU it would wait for the device, and compiled code
    needs fixed shapes.
    """
    if mask.device.type != "cpu" or torch.compiler.is_compiling():
        return torch.arange(len(mask), device=mask.device)
    return mask.nonzero().squeeze(-1)
