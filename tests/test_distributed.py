"""Several processes train one agent: on the CPU, over gloo, started as torchrun does or by torchrun itself."""

import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import pytest
import torch

import common
import dqn_cartpole
from runs import AGENTS, ROOT, SCRIPTS, Process, assert_same, assert_same_run, before_update, checkpoint, die, flags
from runs import rows, session, start_ranks, wait_until


def end(ranks, statuses=None):
    assert [rank.wait() for rank in ranks] == (statuses or [0] * len(ranks)), [rank.stderr for rank in ranks]


def new_agent(module, ranks):
    """A tiny agent whose critics do not move, so that the actor's gradients are those of the same critics.

    Nor do they normalize: each process does that within its own share.
    """
    torch.manual_seed(0)
    if module.__name__ == "dqn_cartpole":
        config, more = module.Config(layers=(16,)), ()
    else:
        still = {"critic_learning_rate": 0.0, "critic_batch_norm": False}
        config = module.Config(env_id="Pendulum-v1", actor_layers=(16,), critic_layers=(16,), **still)
        more = (3,)
    with gym.make(config.env_id) as env:
        spaces = env.observation_space, env.action_space
    return getattr(module, AGENTS[module.__name__])(config, *spaces, *more, torch.device("cpu"), ranks)


def joined_batch(module):
    torch.manual_seed(1)
    observations, next_observations = torch.randn(2, 24, 4 if module.__name__ == "dqn_cartpole" else 3)
    observations[1::2, 0] /= 1000  # one rank of two has seen nothing of this number's bounds
    actions = torch.randint(2, (24,)) if module.__name__ == "dqn_cartpole" else torch.rand(24, 1) * 2 - 1
    return observations, actions, torch.randn(24), (torch.rand(24) < 0.3).float(), next_observations


def gradients_of_update(module, ranks):
    """The gradients that one update leaves on this rank, which has its share of the batch and of the first data."""
    torch.set_num_threads(1)
    torch.randn_like = torch.zeros_like  # the actor's samples, which ranks draw apart
    agent = new_agent(module, ranks)
    batch = [part[ranks.rank :: ranks.world_size] for part in joined_batch(module)]
    if module.__name__ == "dqn_cartpole":
        agent.fit_scaling(batch[0], batch[2])
        agent.update(batch, 0)
    else:
        agent.fit_reward_scale(batch[2])
        agent.update(batch)
    return [p.grad for optimizer in agent.optimizers for group in optimizer.param_groups for p in group["params"]]


def save_gradients(module, directory):
    """Makes the gradients of both scripts' agents the run, and the directory that it would have."""

    def main():
        run = common.Run(module.Config(device="cpu", batch_size=24), module.__name__, None, None)
        found = {name: gradients_of_update(sys.modules[name], run.ranks) for name in SCRIPTS}
        torch.save(found | {"path": str(run.path)}, f"{directory}/{run.ranks.rank}.pt")

    module.main = main


@pytest.mark.parametrize("world_size", (2, 3))
def test_averaged_gradients_equal_those_of_the_joined_batch(world_size, tmp_path):
    """And all ranks name the same new directory."""
    for count in (1, world_size):
        (tmp_path / str(count)).mkdir()
        hook = partial(save_gradients, directory=tmp_path / str(count))
        end(start_ranks(count, SCRIPTS[0], [], tmp_path / f"output{count}", hook))
    expected = torch.load(tmp_path / "1" / "0.pt")
    ranks = [torch.load(tmp_path / str(world_size) / f"{rank}.pt") for rank in range(world_size)]
    for averaged in ranks:
        assert averaged["path"] == ranks[0]["path"] and averaged["path"].startswith(f"runs/{SCRIPTS[0]}-")
        for name in SCRIPTS:
            assert all(gradient.abs().max() > 0 for gradient in expected[name])
            for gradient, right in zip(averaged[name], expected[name], strict=True):
                torch.testing.assert_close(gradient, right, rtol=1e-5, atol=1e-6 * float(right.abs().max()))


def save_agents(module, directory):
    """Saves each rank's agent, as it is at the end."""
    finish = common.Run.finish

    def save_and_finish(run, *arguments):
        torch.save(run.agent.state_dict(), f"{directory}/{run.ranks.rank}.pt")
        finish(run, *arguments)

    common.Run.finish = save_and_finish


def tiny(name, run_dir):
    return flags(name, run_dir, "--num-envs", 2, "--collect-steps-per-iteration", 2, "--num-iterations", 240)


@pytest.fixture(scope="module", params=[("sac_minitaur", 2), ("dqn_cartpole", 3)])
def trained(request, tmp_path_factory):
    """A run of N processes that was left alone: its directory, its processes and N."""
    script, world_size = request.param
    path = tmp_path_factory.mktemp(script)
    hook = partial(save_agents, directory=path)
    ranks = start_ranks(world_size, script, tiny(script, path / "run"), path / "output", hook)
    end(ranks)
    return path / "run", ranks, world_size


def test_all_ranks_stop_with_one_and_each_has_experience_of_its_own(script, tmp_path):
    """Of two processes, two environments each, the second alone is asked to stop."""
    more = ["--num-envs", 2, "--num-iterations", 10**6, "--replay-buffer-capacity", 10**6]
    ranks = start_ranks(2, script, flags(script, tmp_path / "run", *more), tmp_path / "output")
    wait_until((tmp_path / "run" / "train.csv").exists)
    ranks[1].kill(signal.SIGTERM)
    end(ranks)
    assert f"torchrun --nproc-per-node 2 {script}.py --resume " in ranks[0].stdout
    state = checkpoint(tmp_path / "run")
    assert 0 < state["step"] < 10**6 and len(state["ranks"]) == 2
    assert sum(len(own["buffer"]["rows"]) for own in state["ranks"]) == state["env_steps"]  # the counts are right
    first = [tuple(row[:3].tolist()) for own in state["ranks"] for row in own["buffer"]["rows"][:2]]
    assert len(set(first)) == 4  # the first observations of the four environments
    assert not torch.equal(*(own["random"]["cpu"] for own in state["ranks"]))


def test_all_ranks_train_one_agent_and_rank_0_alone_prints_and_writes(trained):
    """The same parameters to the last bit after 240 updates, although each rank has experience of its own."""
    run_dir, ranks, world_size = trained
    agents = [torch.load(run_dir.parent / f"{rank}.pt") for rank in range(world_size)]
    for agent in agents[1:]:
        assert_same(agent, agents[0])
    assert "finished" in ranks[0].stdout
    assert all(rank.stdout == "" for rank in ranks[1:])
    assert all(rank.stderr == "" for rank in ranks), [rank.stderr for rank in ranks]
    assert len(list(run_dir.glob("events.*"))) == 1
    # Two environment steps for each update, of all environments of all processes, after the initial ones.
    for step, env_steps in (map(int, row[:2]) for row in rows(run_dir / "train.csv")[1:]):
        assert 96 + 2 * step <= env_steps < 96 + 2 * step + 2 * (2 * world_size), (step, env_steps)


def test_killed_and_resumed_exactly_with_as_many_processes(trained, tmp_path):
    run_dir, _, world_size = trained
    script = checkpoint(run_dir)["script"]
    ranks = start_ranks(world_size, script, tiny(script, tmp_path / "run"), tmp_path / "1", kill_rank_1)
    # The others lose it, say so, and end, without anybody to end them.
    assert [rank.wait() for rank in ranks] == [1, -signal.SIGKILL, 1][:world_size]
    assert ranks[0].stderr.startswith("error: lost another process") and ranks[0].stderr.count("\n") == 1
    assert 0 < checkpoint(tmp_path / "run")["step"] < 240
    alone = Process(script, ["--resume", tmp_path / "run"], tmp_path / "alone")
    end([alone], [2])
    assert f"saved by {world_size} processes" in alone.stderr and alone.stderr.count("\n") == 1
    end(start_ranks(world_size, script, ["--resume", tmp_path / "run"], tmp_path / "2"))
    assert_same_run(tmp_path / "run", run_dir)


def kill_rank_1(module):
    if os.environ["RANK"] == "1":
        before_update(module, 130, die)


def test_two_processes_solve_cartpole(tmp_path):
    """By 5 000, as each of the ten seeds that README reports does with one process."""
    arguments = ["--device", "cpu", "--no-video", "--num-iterations", 5000, "--run-dir", tmp_path / "run"]
    end(start_ranks(2, "dqn_cartpole", arguments, tmp_path / "output"))
    header, *evaluations = rows(tmp_path / "run" / "eval.csv")
    assert max(float(row[header.index("average_return")]) for row in evaluations) >= 195


def test_each_process_takes_a_gpu_of_its_own(monkeypatch):
    for gpus, device in ((0, "cpu"), (2, "cuda:1")):
        monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
        assert common.select_device("auto", local_rank=1) == torch.device(device)
    ranks = SimpleNamespace(rank=0, world_size=2, local_rank=0)
    with monkeypatch.context() as two, pytest.raises(common.InputError, match="--device cuda:1: .*use --device cuda$"):
        two.setattr(common, "Ranks", lambda: ranks)
        common.Run(dqn_cartpole.Config(device="cuda:1"), "dqn_cartpole", None, None)
    for name, rank in (("auto", 2), ("cuda", 2), ("cuda:2", 0)):
        with pytest.raises(common.InputError, match="--device cuda:2 is not there.*2.*: use --device cpu"):
            common.select_device(name, rank)


@pytest.mark.parametrize(
    "size, said", [(25, "cannot be shared by 2 processes"), (258, "is more than the 256 transitions stored at first")]
)
def test_batches_that_two_processes_cannot_take(size, said, tmp_path):
    few = ("--batch-size", size, "--initial-collect-steps", 256, "--replay-buffer-capacity", 1000)
    ranks = start_ranks(2, "sac_minitaur", flags("sac_minitaur", tmp_path / "run", *few), tmp_path / "output")
    end(ranks, [2, 2])
    assert ranks[0].stderr == f"error: --batch-size {size} {said}\n"
    assert not (tmp_path / "run").exists()


def test_torchrun_ends_when_a_rank_is_killed(tmp_path):
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command = [*torchrun, ROOT / "sac_minitaur.py", *flags("sac_minitaur", tmp_path / "run", "--num-iterations", 10**6)]
    process = subprocess.Popen(list(map(str, command)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_until((tmp_path / "run" / "train.csv").exists)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    ranks = [int(pid) for pid in children if b"\0RANK=" in Path(f"/proc/{pid}/environ").read_bytes()]
    os.kill(ranks[1], signal.SIGKILL)
    assert process.wait(600) != 0
    wait_until(lambda: not any(map(session, ranks)), seconds=60)  # one session per rank
    assert len(checkpoint(tmp_path / "run")["ranks"]) == 2
