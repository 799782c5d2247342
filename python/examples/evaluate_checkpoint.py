"""Evaluates a checkpoint of SCTN in PyTorch: python examples/evaluate_checkpoint.py CHECKPOINT --problem placing."""

import argparse

import gymnasium

import multiravens  # noqa: F401  (registers the environments)
from multiravens.network import Policy


def main() -> None:
    """Prints the completion rate over test episodes, as `sctn evaluate` does."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", help="such as config/checkpoints/ten_problems.safetensors")
    parser.add_argument("--problem", default="placing")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=10_000, help="of the first episode; the next ones are seed + 2, seed + 4, ...")
    parser.add_argument("--start", choices=["same", "other"], default="same", help="where the shown demonstration begins")
    arguments = parser.parse_args()
    policy = Policy.load(arguments.checkpoint)
    goal = "final" if policy.conditioning == "final" else "next"
    environment = gymnasium.make(f"MultiRavens/{arguments.problem}-v0", goal=goal, start=arguments.start, demonstrator=False)
    completed, total = 0, 0.0
    for episode in range(arguments.episodes):
        observation, info = environment.reset(seed=arguments.seed + 2 * episode)
        failed: list[list[float]] = []
        over = False
        while not over:
            action = policy.decide(observation, exclude=failed, radius_m=0.005).action
            observation, reward, terminated, truncated, info = environment.step(action)
            over = terminated or truncated
            # A pick that met or held nothing is left out until something has moved.
            missed = info["outcome"] in ("no_contact", "grasp_failed")
            failed = [*failed, list(action[:2])] if missed and reward == 0.0 else []
        completed += terminated
        total += info["total_reward"]
        print(f"seed {info['seed']}: {info['step']} steps, reward {info['total_reward']:.3f}", flush=True)
    print(f"completed {completed} of {arguments.episodes}, reward {total / arguments.episodes:.3f}")


if __name__ == "__main__":
    main()
