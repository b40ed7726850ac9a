import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch.nn import Linear

from coil_rl.learners.networks import FastTensorDictModule


def test_fast_module_computes_what_a_tensordict_module_computes():
    split = Linear(3, 4)
    ours, theirs = (
        kind(lambda x: tuple(split(x).chunk(2, -1)), ["x"], ["a", "b"])
        for kind in (FastTensorDictModule, TensorDictModule)
    )
    data = TensorDict({"x": torch.randn(5, 3)}, [5])
    assert (ours(data.clone()) == theirs(data.clone())).all()
