"""Several processes train one SAC agent: on the CPU, over gloo, started as torchrun does or by torchrun itself."""

import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import gymnasium as gym
import pytest
import torch

import common
from runs import ROOT, Process, assert_same, assert_same_run, before_update, checkpoint, die, flags
from runs import rows, session, start_ranks, wait_until

SCRIPT = "sac_minitaur"


def end(ranks, statuses=None):
    assert [rank.wait() for rank in ranks] == (statuses or [0] * len(ranks)), [rank.stderr for rank in ranks]


def gradients_of_update(module):
    """The gradients that one update leaves on this rank, which has its share of the batch and of the first data.

    Critics do not move, so that the actor's gradients are those of the same critics, and do not normalize: each process
    does that within its own share.
    """
    rank, world_size, _ = common.join_processes()
    torch.set_num_threads(1)
    torch.randn_like = torch.zeros_like  # the actor's samples, which ranks draw apart
    torch.manual_seed(0)
    still = {"critic_learning_rate": 0.0, "critic_batch_norm": False}
    config = module.Config(env_id="Pendulum-v1", actor_layers=(16,), critic_layers=(16,), **still)
    space = gym.spaces.Box(-1, 1, (3,)), gym.spaces.Box(-2, 2, (1,))
    agent = module.SACAgent(config, *space, 3, torch.device("cpu"))
    observations, next_observations = torch.randn(2, 24, 3)
    observations[1::2, 0] /= 1000  # one rank of two has seen nothing of this number's bounds
    batch = observations, torch.rand(24, 1) * 2 - 1, torch.randn(24), (torch.rand(24) < 0.3).float(), next_observations
    batch = [part[rank::world_size] for part in batch]
    agent.fit_scaling(batch[0], batch[2])
    agent.update(batch, 0)
    return [p.grad for optimizer in agent.optimizers for group in optimizer.param_groups for p in group["params"]]


def save_gradients(module, directory):
    """Makes the gradients of an update the run."""

    def main():
        torch.save(gradients_of_update(module), f"{directory}/{os.environ.get('RANK', 0)}.pt")

    module.main = main


@pytest.mark.parametrize("world_size", (2, 3))
def test_averaged_gradients_equal_those_of_the_joined_batch(world_size, tmp_path):
    for count in (1, world_size):
        (tmp_path / str(count)).mkdir()
        hook = partial(save_gradients, directory=tmp_path / str(count))
        end(start_ranks(count, SCRIPT, [], tmp_path / f"output{count}", hook))
    expected = torch.load(tmp_path / "1" / "0.pt")
    assert all(gradient.abs().max() > 0 for gradient in expected)
    for rank in range(world_size):
        for gradient, right in zip(torch.load(tmp_path / str(world_size) / f"{rank}.pt"), expected, strict=True):
            torch.testing.assert_close(gradient, right, rtol=1e-5, atol=1e-6 * float(right.abs().max()))


def save_agents(module, directory):
    """Saves each rank's agent, as it is at the end."""
    finish = common.Run.finish

    def save_and_finish(run, *arguments):
        torch.save(run.agent.state_dict(), f"{directory}/{run.rank}.pt")
        finish(run, *arguments)

    common.Run.finish = save_and_finish


def tiny(run_dir):
    return flags(SCRIPT, run_dir, "--num-envs", 2, "--num-iterations", 200)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of two processes that was left alone: its directory and its processes."""
    path = tmp_path_factory.mktemp("ranks")
    ranks = start_ranks(2, SCRIPT, tiny(path / "run"), path / "output", partial(save_agents, directory=path))
    end(ranks)
    return path / "run", ranks


def test_all_train_one_agent_and_process_0_alone_prints_and_writes(trained):
    """The same parameters to the last bit after 200 updates, although each has experience of its own."""
    run_dir, ranks = trained
    assert_same(*(torch.load(run_dir.parent / f"{rank}.pt") for rank in range(2)))
    assert "finished" in ranks[0].stdout and ranks[1].stdout == ""
    assert all(rank.stderr == "" for rank in ranks), [rank.stderr for rank in ranks]
    assert len(list(run_dir.glob("events.*"))) == 1
    state = checkpoint(run_dir)
    first = [tuple(row.tolist()) for own in state["processes"] for row in own["replay"]["observations"][:0]]
    assert len(set(first)) == len(first) and not torch.equal(*(own["random"] for own in state["processes"]))
    # Two environments of two processes step once for each update, after 96 random steps.
    assert all(int(row[1]) == 96 + 4 * int(row[0]) for row in rows(run_dir / "train.csv")[1:])


def test_killed_and_resumed_exactly_with_as_many_processes(trained, tmp_path):
    run_dir, _ = trained
    ranks = start_ranks(2, SCRIPT, tiny(tmp_path / "run"), tmp_path / "1", kill_rank_1)
    assert [rank.wait() for rank in ranks] == [1, -signal.SIGKILL]  # the other loses it and ends
    assert 0 < checkpoint(tmp_path / "run")["step"] < 200
    alone = Process(SCRIPT, ["--resume", tmp_path / "run"], tmp_path / "alone")
    assert alone.wait() == 2 and "saved by 2 processes" in alone.stderr and alone.stderr.count("\n") == 1
    end(start_ranks(2, SCRIPT, ["--resume", tmp_path / "run"], tmp_path / "2"))
    assert_same_run(tmp_path / "run", run_dir)


def kill_rank_1(module):
    if os.environ["RANK"] == "1":
        before_update(module, 130, die)


def test_all_stop_with_one(tmp_path):
    """Of two processes the second alone is asked to stop, in its random steps or later."""
    more = ["--num-envs", 2, "--num-iterations", 10**6, "--replay-buffer-capacity", 10**6]
    ranks = start_ranks(2, SCRIPT, flags(SCRIPT, tmp_path / "run", *more), tmp_path / "output")
    wait_until((tmp_path / "run" / "train.csv").exists)
    ranks[1].kill(signal.SIGTERM)
    end(ranks, [130, 130])
    assert "to continue: --resume" in ranks[0].stdout
    state = checkpoint(tmp_path / "run")
    assert 0 < state["step"] < 10**6 and len(state["processes"]) == 2
    assert sum(own["size"] for own in state["processes"]) == state["env_steps"]  # the counts are right
    first = [tuple(row.tolist()) for own in state["processes"] for row in own["replay"]["observations"][:2]]
    assert len(set(first)) == 4  # the first observations of the four environments


@pytest.mark.parametrize(
    "size, said", [(25, "cannot be shared by 2 processes"), (258, "is more than the transitions stored at first")]
)
def test_batches_that_two_processes_cannot_take(size, said, tmp_path):
    few = ("--batch-size", size, "--initial-collect-steps", 256, "--replay-buffer-capacity", 1000)
    ranks = start_ranks(2, SCRIPT, flags(SCRIPT, tmp_path / "run", *few), tmp_path / "output")
    end(ranks, [2, 2])
    assert ranks[0].stderr.startswith(f"error: --batch-size {size} {said}") and ranks[1].stderr == ""
    assert not (tmp_path / "run").exists()


def test_torchrun_ends_when_a_rank_is_killed(tmp_path):
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command = [*torchrun, ROOT / "sac_minitaur.py", *flags(SCRIPT, tmp_path / "run", "--num-iterations", 10**6)]
    process = subprocess.Popen(list(map(str, command)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_until((tmp_path / "run" / "train.csv").exists)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    ranks = [int(pid) for pid in children if b"\0RANK=" in Path(f"/proc/{pid}/environ").read_bytes()]
    os.kill(ranks[1], signal.SIGKILL)
    assert process.wait(600) != 0
    wait_until(lambda: not any(map(session, ranks)), seconds=60)  # one session per rank
    assert len(checkpoint(tmp_path / "run")["processes"]) == 2
