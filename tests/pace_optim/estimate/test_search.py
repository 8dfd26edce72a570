"""The loop around the search."""

from types import SimpleNamespace

from pace_optim.estimate.search import search
from pace_optim.terminal.processes import Processes


def test_the_loop_asks_simulates_tells_and_evolves_until_finished():
    calls = []

    class Optimizer:
        generation, reads_positions_alone, processes = 0, False, Processes()

        def finished(self):
            return self.generation == 2

        def ask(self):
            calls.append("ask")

        def update_simulator(self, rollout):
            calls.append("update")

        def tell(self, sim_dof_pos, real_dof_pos):
            calls.append(f"tell {sim_dof_pos}{real_dof_pos}")

        def evolve(self):
            calls.append("evolve")
            self.generation += 1

    search(Optimizer(), [("a", "b"), ("c", "d")], lambda o: calls.append(f"after {o.generation}"))
    once = ["ask", "update", "tell ab", "tell cd", "evolve"]
    assert calls == [*once, "after 1", *once, "after 2"]


def test_the_process_that_writes_says_when_a_shared_search_ends():
    """It knows the number of generations: a helper went on to its own."""
    said = iter([False, False, True])
    asked = []
    helper = SimpleNamespace(
        processes=SimpleNamespace(agree=lambda own: next(said)),
        finished=lambda: len(asked) > 9,
        ask=lambda: asked.append(1),
        update_simulator=lambda rollout: None,
        evolve=lambda: None,
        reads_positions_alone=False,
    )
    search(helper, [])
    assert len(asked) == 2
