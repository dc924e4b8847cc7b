"""Learning code that is not xreset's: proximal policy optimisation in one file, as CleanRL writes it, on `xreset.VectorEnv`."""

import sys
from pathlib import Path

import torch
from torch import nn
from torch.distributions import Normal

import xreset

STEPS, EPOCHS, DISCOUNT, LAMBDA, CLIP = 32, 4, 0.99, 0.95, 0.2


def main(bank: Path, iterations: int = 3, num_envs: int = 8) -> None:
    """Train actor and critic on the flat observations for a few iterations; ``bank``: a file of example 02."""
    robot, states = xreset.load_robot("openarm"), xreset.read_bank(bank)
    objects, joints = [xreset.load_object(name) for name in states.object_names], len(robot.joints)
    envs = xreset.VectorEnv(
        xreset.make_env(robot, objects, states, num_envs=num_envs)
    )  # says so where gymnasium is missing

    def flat(seen) -> torch.Tensor:
        return torch.cat([torch.as_tensor(seen[group]) for group in ("policy", "proprio")], dim=1)

    seen, ended = flat(envs.reset(seed=0)[0]), torch.zeros(num_envs, dtype=torch.bool)
    actor, critic = (
        nn.Sequential(nn.Linear(seen.shape[1], 64), nn.Tanh(), nn.Linear(64, n))
        for n in (joints, 1)
    )
    log_std = nn.Parameter(torch.full((joints,), -1.0))
    optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters(), log_std], 3e-4)
    for iteration in range(iterations):
        rows = []
        for _ in range(STEPS):
            with torch.no_grad():
                policy = Normal(actor(seen), log_std.exp())
                action, value = policy.sample(), critic(seen)[:, 0]
                observations, *outcome, _ = envs.step(action.clamp(-1, 1).numpy())
                after, (reward, terminated, truncated) = (
                    flat(observations),
                    map(torch.as_tensor, outcome),
                )
                future = (
                    critic(after)[:, 0] * ~terminated
                )  # an episode whose time is over goes on in its value
            begins, ended = ended, terminated | truncated
            rows.append(
                (
                    seen,
                    action,
                    policy.log_prob(action).sum(1),
                    value,
                    reward + DISCOUNT * future,
                    reward,
                    begins,
                    ended,
                )
            )
            seen = after
        obs, act, logp, value, target, reward, begins, end = (
            torch.stack(part) for part in zip(*rows, strict=True)
        )
        advantage, carry = target - value, torch.zeros(num_envs)
        for t in reversed(range(STEPS)):
            carry = advantage[t] = advantage[t] + DISCOUNT * LAMBDA * ~end[t] * carry
        real = ~begins  # a step that only begins an episode (Gymnasium's NEXT_STEP) teaches nothing
        obs, act, logp, gain, aim = (
            x[real] for x in (obs, act, logp, advantage, advantage + value)
        )
        gain = (gain - gain.mean()) / (gain.std() + 1e-8)
        for _ in range(EPOCHS):
            ratio = (Normal(actor(obs), log_std.exp()).log_prob(act).sum(1) - logp).exp()
            loss = (
                -torch.min(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
                + (critic(obs)[:, 0] - aim).square().mean()
            )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        print(
            f"iteration {iteration + 1}: reward per step {reward[real].mean():.4f}, {int(end.sum())} episodes ended"
        )
    envs.close()


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "bank.npz"))
