"""What numpy code prepares for the update, with the faults that a second account of it shows."""

import equinox as eqx
import numpy as np
import pytest

import ppo_dap
from ppo_dap.ppo.rollout import Collector
from ppo_dap.training.trainer import Trainer

FRESH = "every row of the actor update is of the current batch (share)"
STEPS = {"steps": 800, "progress": False, "eval_every": 0, "eval_episodes": 1}


def edited(edit):
    """A fault in the rollout as it is handed on: `edit(part, memory)` returns what is put in place of each part."""

    def plant(monkeypatch):
        real, memory = Collector.collect, {}

        def collect(self, policy, steps, parts, iteration, rng):
            for number, part in enumerate(real(self, policy, steps, parts, iteration, rng)):
                yield part if iteration < 2 else changed(part, **edit(part, memory.get(number), policy))
                memory[number] = part

        monkeypatch.setattr(Collector, "collect", collect)

    return plant


def changed(part, **columns):
    return type(part)(**vars(part) | columns)


def shaped_rewards(part, before, policy):
    return {"rewards": part.rewards + np.float32(1e-3)}


def the_batch_before_as_if_it_were_new(part, before, policy):
    """Under new ids, with densities and means of the policy that learns: the ratio is 1, and the gate lets it pass."""
    flat = before.observations.reshape(-1, before.observations.shape[-1])
    means = policy.mean(flat).reshape(before.means.shape)
    log_probs = policy.log_prob_of_noise((before.actions - means) / np.exp(policy.log_std))
    return {"state_ids": part.state_ids, "means": means, "log_probs": log_probs} | {
        name: getattr(before, name) for name in ("observations", "next_observations", "actions", "rewards")
    }


def a_logged_successor(part, before, policy):
    successors = part.next_observations.copy()
    successors[0, 0] = 0.5
    return {"next_observations": successors}


def ids_of_other_rows(part, before, policy):
    return {"state_ids": part.state_ids[::-1]}


def actions_of_another(monkeypatch):
    """Another's actions are executed now and then, with their density under the policy: the ratio is 1 again."""
    real = Collector._part

    def part(self, policy, spread):
        spread = spread.copy()
        spread[0] = 0.3
        return real(self, policy, spread)

    def log_prob(policy, noise):
        noise = noise.copy()
        noise[0] = np.float32(0.3) / np.exp(policy.log_std)
        return -0.5 * np.square(noise).sum(-1) - np.float32(
            policy.log_std.sum() + 0.5 * np.log(2 * np.pi) * len(policy.log_std)
        )

    monkeypatch.setattr(Collector, "_part", part)
    monkeypatch.setattr("ppo_dap.nets.policy.Policy.log_prob_of_noise", log_prob)


def after_each(edit):
    """A fault of the trainer's: `edit(state)` after the second iteration and each later one."""

    def plant(monkeypatch):
        real = Trainer.iterate

        def iterate(self, collector):
            real(self, collector)
            if self.state.iteration >= 2:
                edit(self.state)

        monkeypatch.setattr(Trainer, "iterate", iterate)

    return plant


def cloned_again(state):
    state.learner = eqx.tree_at(lambda s: s.ppo.actor.log_std, state.learner, state.learner.ppo.actor.log_std - 0.01)


def logs_in_the_normaliser(state):
    state.observations = state.observations.update(np.zeros((5, len(state.observations.mean)), np.float32))


def a_scale_by_logs(monkeypatch):
    real = Trainer._reward_std

    def reward_std(self, parts):
        real(self, parts)
        moments = self.state.reward_scale.moments.update(np.ones((5, 1)))
        self.state.reward_scale = self.state.reward_scale._replace(moments=moments)
        return np.asarray(self.state.reward_scale.std, np.float32)

    monkeypatch.setattr(Trainer, "_reward_std", reward_std)


FAULTS = {
    "rewards that somebody shaped": edited(shaped_rewards),
    "the batch before as if it were new": edited(the_batch_before_as_if_it_were_new),
    "a logged successor in the batch": edited(a_logged_successor),
    "ids of other rows": edited(ids_of_other_rows),
    "actions of another": actions_of_another,
    "networks that were changed between iterations": after_each(cloned_again),
    "logs in the observations' statistics": after_each(logs_in_the_normaliser),
    "logs in the rewards' scale": a_scale_by_logs,
}


def trained(out, small):
    return ppo_dap.train("Hopper-v5", "ppo", out=out, **STEPS, **{k: v for k, v in small.items() if k not in STEPS})


def broken(run):
    return [claim.statement for claim in run.audit() if not claim.holds]


def test_without_a_fault_every_row_is_witnessed(tmp_path, small):
    run = trained(tmp_path / "run", small)
    assert {row["witnessed"] for row in run.metrics} == {row["batch_fresh"] for row in run.metrics} == {1.0}
    assert broken(run) == []


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_in_what_is_prepared_is_found(tmp_path, monkeypatch, small, name):
    FAULTS[name](monkeypatch)
    run = trained(tmp_path / "run", small)
    assert broken(run) == [FRESH]
    assert run.metrics[-1]["witnessed"] == run.metrics[-1]["batch_fresh"] < 1
    assert all(row["ratio_error"] < 1e-3 for row in run.metrics)


def test_what_the_environments_return_cannot_be_changed_in_place(tmp_path, monkeypatch, small):
    real = Collector._count

    def count(self, step):
        step.rewards[:] += 1
        real(self, step)

    monkeypatch.setattr(Collector, "_count", count)
    with pytest.raises(ValueError, match="read-only"):
        trained(tmp_path / "run", small)
