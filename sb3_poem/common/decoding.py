"""Sums of a reward decoder's predictions for many latents at once."""

from collections.abc import Sequence

import torch as th

from sb3_poem.common.networks import MLP

# Rows of hidden values at once: enough to pay for a call, few enough for a core's cache.
BLOCK_ROWS = 2000


@th.no_grad()
def decoded_sums(
    mlp: MLP, transitions: th.Tensor, lengths: Sequence[int], embeddings: th.Tensor, dtype: th.dtype
) -> th.Tensor:
    """The decoder's outputs, summed over each trajectory, under each embedding (m, latent_dim): (m,
    trajectories), without gradients. The first layer sees the transitions once.

    :param transitions: (steps of all trajectories, transition_dim), one trajectory after the other
    :param lengths: Steps of each trajectory
    :param dtype: Arithmetic of the hidden layers
    """
    sums = transitions.new_empty(len(embeddings), len(lengths))
    first, start, rows = 0, 0, 0
    for index, length in enumerate(lengths):
        if rows and rows + length > BLOCK_ROWS:
            group = transitions[start : start + rows], lengths[first:index]
            sums[:, first:index] = _group_sums(mlp, *group, embeddings, dtype)
            first, start, rows = index, start + rows, 0
        rows += length
    sums[:, first:] = _group_sums(mlp, transitions[start:], lengths[first:], embeddings, dtype)
    return sums


def _group_sums(
    mlp: MLP, transitions: th.Tensor, lengths: Sequence[int], embeddings: th.Tensor, dtype: th.dtype
) -> th.Tensor:
    first, *others = [*mlp.hidden, mlp.output]
    assert isinstance(first, th.nn.Linear)
    widths = [transitions.shape[-1], embeddings.shape[-1]]
    of_transitions, of_embeddings = first.weight.split(widths, dim=1)
    base = (transitions @ of_transitions.T + first.bias).to(dtype)  # (rows, width)
    shifts = (embeddings @ of_embeddings.T).to(dtype)  # (m, width)
    middle = [(layer.weight.T.to(dtype), layer.bias.to(dtype)) for layer in others[:-1]]  # type: ignore[union-attr, operator]
    last = mlp.output.weight[0].to(dtype)
    block = max(1, BLOCK_ROWS // len(base))
    # the same memory for every block: new pages from the system take longer than to fill them
    rows = min(block, len(shifts)) * len(base)
    buffers = [
        base.new_empty(rows, width)
        for width in (len(first.bias), *(len(bias) for _, bias in middle))
    ]
    sums = []
    for some in shifts.split(block):
        rows = len(some) * len(base)
        x = buffers[0][:rows]
        th.add(base, some[:, None], out=x.view(len(some), *base.shape))
        for (weight, bias), buffer in zip(middle, buffers[1:], strict=True):
            x = th.addmm(bias, mlp.activation(x), weight, out=buffer[:rows])
        if others:
            x = mlp.activation(x) @ last
        parts = x.view(len(some), -1).float().split(list(lengths), dim=1)
        sums.append(th.stack([part.sum(dim=1) for part in parts], dim=1))
    result = th.cat(sums)
    return result + mlp.output.bias * result.new_tensor(lengths) if others else result
