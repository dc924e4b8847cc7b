"""``python tests/train_worker.py FOLDER FIRST SECOND``: two processes train twice, with the arguments of ``xreset train`` in
two texts. What each process of a training ends with is in FOLDER/first-RANK.pt and FOLDER/second-RANK.pt.

The processes are forks of this one, which has imported everything. The second training is stopped in its first iteration
by a signal to the process of rank 1 alone.
"""

import multiprocessing
import os
import shlex
import signal
import socket
import sys
from pathlib import Path
from unittest.mock import patch

import torch

from xreset.cli import main
from xreset.learning.runner import TrainingRunner


def train(file, arguments, is_stopped):
    """Train in a process of the environment, write what it ends with to a file, and write its rank as the policy."""
    learn = TrainingRunner.learn

    def learn_and_tell(runner, *args, **options):
        rates = runner.env.resets.success_rate
        begin = {
            "start_actor": {k: v.clone() for k, v in runner.alg.actor.state_dict().items()},
            "start_success_rate": rates.clone(),
        }
        if not runner.iteration:
            rates.fill_(runner.processes.rank)
        update = runner.alg.update

        def update_and_ask():
            if is_stopped and not runner.processes.is_main:
                os.kill(os.getpid(), signal.SIGTERM)
            return update()

        runner.alg.update = update_and_ask
        number = learn(runner, *args, **options)
        end = {
            "actor": runner.alg.actor.state_dict(),
            "critic": runner.alg.critic.state_dict(),
            "learning_rate": runner.alg.learning_rate,
            "env_steps": runner.env_steps,
            "success_rate": rates,
            "policy_obs": runner.env.get_observations()["policy"],
            "random": runner.env.generator.get_state(),
            "stopped_by": number,
        }
        torch.save(begin | end, file)

    def export(_checkpoint, policy):
        Path(policy).write_text(os.environ["RANK"])

    with (
        patch.object(TrainingRunner, "learn", learn_and_tell),
        patch("xreset.learning.train.export_checkpoint", export),
    ):
        main(["train", *shlex.split(arguments)])


def train_in_two_processes(folder, name, arguments):
    """Start both processes with the environment that ``torchrun`` gives them, and wait."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    os.environ |= {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    processes = []
    for rank in range(2):
        os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank)}
        options = (folder / f"{name}-{rank}.pt", arguments, name == "second")
        process = multiprocessing.get_context("fork").Process(target=train, args=options)
        process.start()
        processes.append(process)
    for process in processes:
        process.join()
        assert process.exitcode == 0, (
            f"a process of the {name} training ended with {process.exitcode}"
        )


if __name__ == "__main__":
    for name, arguments in zip(("first", "second"), sys.argv[2:], strict=True):
        train_in_two_processes(Path(sys.argv[1]), name, arguments)
