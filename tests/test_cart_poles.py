import gymnasium
import torch
from cart_poles import CartPoles
from torchrl.envs.utils import check_env_specs


def test_states_equal_those_of_gymnasium():
    check_env_specs(CartPoles(3))
    ours, theirs = CartPoles(1), gymnasium.make("CartPole-v1").unwrapped
    theirs.reset(seed=0)
    state = ours.reset()
    theirs.state = tuple(state["observation"][0].tolist())
    fallen = False
    while not fallen:
        push = torch.randint(2, (1,))
        state = ours.step(state.set("action", push))["next"]
        expected, _, fallen, _, _ = theirs.step(push.item())
        torch.testing.assert_close(state["observation"][0], torch.from_numpy(expected), rtol=1e-4, atol=1e-4)
    assert state["terminated"].item()
