import torch
from tensordict import TensorDict

from coil_rl.transforms.answers import Answers


class Oracle:
    def __init__(self):
        self.asked = 0

    def __call__(self, data):
        self.asked += len(data)
        return data["x"].sum(-1, keepdim=True) + data["n"].unsqueeze(-1)


def rows(*values):
    x = torch.tensor(values, dtype=torch.float32)
    return TensorDict({"x": torch.stack([x, 2 * x], -1), "n": x.long()}, [len(values)])


def test_answers_are_those_of_the_function():
    answers, oracle = Answers(), Oracle()
    for data in (rows(1, 2, 1), rows(2), rows(3, 3, 1), rows(), rows(1, 2, 3)):
        assert torch.equal(answers(data, oracle), Oracle()(data))
    assert oracle.asked == 5, "only rows that are new should be asked about"


def test_no_more_than_the_limit_is_remembered():
    answers, oracle = Answers(limit=3), Oracle()
    answers(rows(1, 2, 3), oracle)
    for _ in range(2):
        data = rows(1, 4)
        assert torch.equal(answers(data, oracle), Oracle()(data))
    assert oracle.asked == 3 + 2 * 2
    assert len(answers.known[0]) == 3
