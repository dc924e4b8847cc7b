"""``torchrun tests/train_worker.py FOLDER ARGUMENTS``: ``xreset train ARGUMENTS``, and what each process ends with in FOLDER/RANK.pt."""

import sys
from pathlib import Path

import torch

from xreset.cli import main
from xreset.learning.runner import TrainingRunner


def run(folder, arguments):
    learn = TrainingRunner.learn

    def learn_and_tell(runner, *args, **options):
        rates = runner.env.resets.success_rate
        begin = {
            "start_actor": {k: v.clone() for k, v in runner.alg.actor.state_dict().items()},
            "start_success_rate": rates.clone(),
        }
        if not runner.iteration:
            rates.fill_(runner.processes.rank)
        learn(runner, *args, **options)
        end = {
            "actor": runner.alg.actor.state_dict(),
            "critic": runner.alg.critic.state_dict(),
            "learning_rate": runner.alg.learning_rate,
            "env_steps": runner.env_steps,
            "success_rate": rates,
            "policy_obs": runner.env.get_observations()["policy"],
            "random": runner.env.generator.get_state(),
        }
        torch.save(begin | end, folder / f"{runner.processes.rank}.pt")

    TrainingRunner.learn = learn_and_tell
    main(["train", *arguments])


if __name__ == "__main__":
    run(Path(sys.argv[1]), sys.argv[2:])
