import pytest

from coil_rl.learners import AfterFrames, AtConvergence, Phases


def phases(guides=3, **options):
    return Phases(guides, agent_phase=AfterFrames(20), guide_phase=AfterFrames(10), **options)


def turns(of, updates, frames=10):
    """Who learns in each update, as (agent, guides)."""
    found = []
    for _ in range(updates):
        found.append((of.turn.agent, of.turn.guides))
        of.advance(frames, reward=0.0)
    return found


def test_agent_and_guides_alternate_for_as_many_frames_as_each_gets():
    agent = (True, ())
    assert turns(phases(), 8) == [agent, agent, (False, (0,)), agent, agent, (False, (1,)), agent, agent]


def test_sequential_takes_guide_i_mod_n_in_the_ith_guide_phase():
    chosen = [guides[0] for agent, guides in turns(phases(3), 24) if not agent]
    assert chosen == [0, 1, 2, 0, 1, 2, 0, 1]


def test_stochastic_is_uniform_and_follows_from_the_seed():
    def chosen(seed):
        return [guides[0] for _, guides in turns(phases(3, order="guide", choice="stochastic", seed=seed), 300)]

    assert chosen(1) == chosen(1) != chosen(2)
    assert all(70 < chosen(1).count(guide) < 130 for guide in range(3))


def test_controls_have_one_kind_of_phase():
    assert set(turns(phases(2, order="joint"), 9)) == {(True, (0, 1))}
    assert set(turns(phases(2, order="agent"), 9)) == {(True, ())}
    assert turns(phases(2, order="guide"), 4) == [(False, (0,)), (False, (1,)), (False, (0,)), (False, (1,))]


def test_each_kind_counts_its_own_earlier_phases():
    of, earlier = phases(), []
    for _ in range(9):
        earlier.append(of.turn.earlier)
        of.advance(20, reward=0.0)
    assert earlier == [0, 0, 1, 1, 2, 2, 3, 3, 4]


@pytest.mark.parametrize("choice", ["sequential", "stochastic"])
def test_a_state_goes_on_in_the_middle_of_a_phase(choice):
    whole, first = phases(choice=choice), phases(choice=choice)
    expected = turns(whole, 60)
    before = turns(first, 25)
    second = phases(choice=choice, seed=9)
    second.load_state_dict(first.state_dict())
    assert before + turns(second, 35) == expected


def test_convergence_is_no_improvement_over_several_evaluations():
    ends = AtConvergence(evaluations=2, improvement=0.1)
    assert not ends(100, [1.0, 2.0, 1.9])
    assert ends(100, [1.0, 2.0, 1.9, 2.05])  # not by enough
    assert not ends(100, [1.0, 2.0, 1.9, 2.2])
    assert not ends(100, [])
    assert AtConvergence(evaluations=5, frames=100)(100, [1.0])


def test_a_phase_that_converges_hands_over_and_forgets_its_rewards():
    of = Phases(1, agent_phase=AtConvergence(1), guide_phase=AtConvergence(1))
    ended = [of.advance(1, reward) for reward in (1, 2, 1.5, 1, 0.5)]
    assert ended == [False, False, True, False, True]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Phases(0), "guides=0 must be at least 1"),
        (lambda: Phases(2, order="both"), "order='both'"),
        (lambda: Phases(2, choice="first"), "choice='first'"),
        (lambda: AfterFrames(0), "frames=0 must be at least 1"),
        (lambda: AtConvergence(0), "evaluations=0 must be at least 1"),
        (lambda: AtConvergence(improvement=-1), "improvement=-1 must be at least 0"),
        (lambda: AtConvergence(frames=0), "frames=0 must be at least 1, or null"),
    ],
)
def test_phases_that_cannot_be_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()
