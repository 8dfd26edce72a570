"""The loop around the search."""

from pace_optim.estimate.search import search


def test_the_loop_asks_simulates_tells_and_evolves_until_finished():
    calls = []

    class Optimizer:
        generation, reads_positions_alone = 0, False

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
