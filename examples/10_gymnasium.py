"""Learning code of your own: proximal policy optimisation in one file, as CleanRL writes it."""

import sys
from pathlib import Path

import torch
from torch import nn
from torch.distributions import Normal

import xreset

STEPS, EPOCHS, DISCOUNT, LAMBDA, CLIP = 32, 4, 0.99, 0.95, 0.2


def main(bank: Path, iterations: int = 3, num_envs: int = 8) -> None:
    """Train actor and critic on the flat observations; ``bank``: a file of example 02."""
    robot, states = xreset.load_robot("openarm"), xreset.read_bank(bank)
    objects, joints = [xreset.load_object(name) for name in states.object_names], len(robot.joints)
    # an error says what to install if gymnasium is missing
    envs = xreset.VectorEnv(xreset.make_env(robot, objects, states, num_envs=num_envs))

    def flat(seen) -> torch.Tensor:
        return torch.cat([torch.as_tensor(seen[group]) for group in ("policy", "proprio")], dim=1)

    seen, ended = flat(envs.reset(seed=0)[0]), torch.zeros(num_envs, dtype=torch.bool)
    width = seen.shape[1]
    actor = nn.Sequential(nn.Linear(width, 64), nn.Tanh(), nn.Linear(64, joints))
    critic = nn.Sequential(nn.Linear(width, 64), nn.Tanh(), nn.Linear(64, 1))
    log_std = nn.Parameter(torch.full((joints,), -1.0))
    optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters(), log_std], 3e-4)
    for iteration in range(iterations):
        rows = []
        for _ in range(STEPS):
            with torch.no_grad():
                policy = Normal(actor(seen), log_std.exp())
                action, value = policy.sample(), critic(seen)[:, 0]
                observations, *outcome, _ = envs.step(action.clamp(-1, 1).numpy())
                after = flat(observations)
                reward, terminated, truncated = map(torch.as_tensor, outcome)
                # an episode whose time is over goes on in its value
                future = critic(after)[:, 0] * ~terminated
            begins, ended = ended, terminated | truncated
            logp = policy.log_prob(action).sum(1)
            target = reward + DISCOUNT * future
            rows.append((seen, action, logp, value, target, reward, begins, ended))
            seen = after
        rollout = [torch.stack(part) for part in zip(*rows, strict=True)]
        obs, act, logp, value, target, reward, begins, end = rollout
        advantage, carry = target - value, torch.zeros(num_envs)
        for t in reversed(range(STEPS)):
            carry = advantage[t] = advantage[t] + DISCOUNT * LAMBDA * ~end[t] * carry
        real = ~begins  # a step that only begins an episode (Gymnasium's NEXT_STEP) teaches nothing
        aim = advantage + value
        obs, act, logp, gain, aim = (x[real] for x in (obs, act, logp, advantage, aim))
        gain = (gain - gain.mean()) / (gain.std() + 1e-8)
        for _ in range(EPOCHS):
            ratio = (Normal(actor(obs), log_std.exp()).log_prob(act).sum(1) - logp).exp()
            policy_loss = -torch.min(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
            value_loss = (critic(obs)[:, 0] - aim).square().mean()
            optimizer.zero_grad()
            (policy_loss + value_loss).backward()
            optimizer.step()
        mean = reward[real].mean()
        print(f"iteration {iteration + 1}: reward per step {mean:.4f}, {int(end.sum())} ended")
    envs.close()


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "bank.npz"))
