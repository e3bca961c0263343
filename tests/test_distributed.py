"""Several processes train one SAC agent: on the CPU, over gloo, started as torchrun does or by torchrun itself."""

import os
import signal
import socket
import subprocess
import sys
from functools import partial
from pathlib import Path
from unittest import mock

import gymnasium as gym
import pytest
import torch

import common
import sac_minitaur
from runs import ROOT, Process, assert_same, assert_same_run, before_call, checkpoint, die, flags
from runs import rows, session, wait_until

SCRIPT = "sac_minitaur"


def start_ranks(arguments, output, hooks=(None, None)):
    """Two processes of a distributed run, as torchrun would start them but without its watch over them."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = str(listener.getsockname()[1])
    environ = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": "2"}
    ranks = []
    for rank, hook in enumerate(hooks):
        environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank)}
        ranks.append(Process(SCRIPT, arguments, output / str(rank), hook, **environ))
    return ranks


def end(ranks, statuses=(0, 0)):
    assert tuple(rank.wait() for rank in ranks) == statuses, [rank.stderr for rank in ranks]


def gradients_of_update():
    """The gradients that one update leaves on this rank, which has its share of the batch and of the first data.

    Critics do not move, so that the actor's gradients are those of the same critics, and do not normalize: each process
    does that within its own share. The actor's samples, which ranks draw apart, are its means.
    """
    rank, world_size = common.join_processes()
    torch.manual_seed(0)
    still = {"critic_learning_rate": 0.0, "critic_batch_norm": False}
    config = sac_minitaur.Config(env_id="Pendulum-v1", actor_layers=(16,), critic_layers=(16,), **still)
    space = gym.spaces.Box(-1, 1, (3,)), gym.spaces.Box(-2, 2, (1,))
    agent = sac_minitaur.SACAgent(config, *space, 3, torch.device("cpu"))
    observations, next_observations = torch.randn(2, 24, 3)
    observations[1::2, 0] /= 1000  # one rank of two has seen nothing of this number's bounds
    batch = observations, torch.rand(24, 1) * 2 - 1, torch.randn(24), (torch.rand(24) < 0.3).float(), next_observations
    batch = [part[rank::world_size] for part in batch]
    agent.fit_scaling(batch[0], batch[2])
    with mock.patch.object(torch, "randn_like", torch.zeros_like):
        agent.update(batch, 0)
    return [p.grad for optimizer in agent.optimizers for group in optimizer.param_groups for p in group["params"]]


def save_gradients(module, directory):
    """Makes the gradients of an update the run."""
    torch.set_num_threads(1)
    module.main = lambda: torch.save(gradients_of_update(), f"{directory}/{os.environ['RANK']}.pt")


def test_averaged_gradients_equal_those_of_the_joined_batch(tmp_path):
    """On each of two processes they are those of one process, which has both halves of the batch."""
    end(start_ranks([], tmp_path / "output", 2 * [partial(save_gradients, directory=tmp_path)]))
    expected = gradients_of_update()
    assert all(gradient.abs().max() > 0 for gradient in expected)
    for rank in range(2):
        for gradient, right in zip(torch.load(tmp_path / f"{rank}.pt"), expected, strict=True):
            torch.testing.assert_close(gradient, right, rtol=1e-5, atol=1e-6 * float(right.abs().max()))


def save_agents(module, directory):
    """Saves each rank's agent, as it is at the end."""
    finish = common.Run.finish

    def save_and_finish(run, *arguments):
        torch.save(run.agent.state_dict(), f"{directory}/{run.rank}.pt")
        finish(run, *arguments)

    common.Run.finish = save_and_finish


def test_two_processes_train_one_agent_and_resume_exactly(tmp_path):
    """The parameters are the same to the last bit, although each has experience of its own. Process 0 alone writes."""
    run_dir = tmp_path / "run"
    hooks = 2 * [partial(save_agents, directory=tmp_path)]
    ranks = start_ranks(flags(SCRIPT, run_dir, "--num-iterations", 100), tmp_path / "output", hooks)
    end(ranks)
    assert_same(*(torch.load(tmp_path / f"{rank}.pt") for rank in range(2)))
    assert "finished" in ranks[0].stdout and ranks[1].stdout == ""
    assert all(rank.stderr == "" for rank in ranks), [rank.stderr for rank in ranks]
    assert len(list(run_dir.glob("events.*"))) == 1
    own, other = checkpoint(run_dir)["processes"]
    assert not torch.equal(own["random"], other["random"])
    assert not torch.equal(own["replay"]["observations"], other["replay"]["observations"])
    # Two environments of two processes step once for each update, after 96 random steps.
    assert all(int(row[1]) == 96 + 4 * int(row[0]) for row in rows(run_dir / "train.csv")[1:])

    killed = tmp_path / "killed"
    hooks = None, partial(before_call, sac_minitaur.SACAgent, "update", 80, die)
    ranks = start_ranks(flags(SCRIPT, killed, "--num-iterations", 100), tmp_path / "1", hooks)
    end(ranks, (1, -signal.SIGKILL))  # the other loses it and ends
    assert checkpoint(killed)["step"] == 50
    alone = Process(SCRIPT, ["--resume", killed], tmp_path / "alone")
    assert alone.wait() == 2 and "saved by 2 processes" in alone.stderr and alone.stderr.count("\n") == 1
    end(start_ranks(["--resume", killed], tmp_path / "2"))
    assert_same_run(killed, run_dir)


def test_all_stop_with_one(tmp_path):
    """Of two processes the second alone is asked to stop."""
    more = ["--num-iterations", 10**6, "--replay-buffer-capacity", 10**6]
    ranks = start_ranks(flags(SCRIPT, tmp_path / "run", *more), tmp_path / "output")
    wait_until((tmp_path / "run" / "train.csv").exists)
    os.kill(ranks[1].pid, signal.SIGTERM)
    end(ranks, (130, 130))
    assert "to continue: --resume" in ranks[0].stdout
    state = checkpoint(tmp_path / "run")
    assert 0 < state["step"] < 10**6 and len(state["processes"]) == 2
    assert sum(own["size"] for own in state["processes"]) == state["env_steps"]  # the counts are right
    first = [tuple(row.tolist()) for own in state["processes"] for row in own["replay"]["observations"][:2]]
    assert len(set(first)) == 4  # the first observations of the four environments


def test_a_batch_that_two_processes_cannot_share():
    config = sac_minitaur.Config(batch_size=25, device="cpu")
    with pytest.raises(common.InputError, match="^--batch-size 25 cannot be shared by 2 processes"):
        common.Run(SCRIPT, config, sac_minitaur.evaluate, rank=0, world_size=2)


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
