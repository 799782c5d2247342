"""Random picks and places, and how little they earn: python examples/random_actions.py [PROBLEM]."""

import sys

import gymnasium

import multiravens  # noqa: F401  (registers the environments)


def main() -> None:
    """Plays three episodes."""
    problem = sys.argv[1] if len(sys.argv) > 1 else "placing"
    environment = gymnasium.make(f"MultiRavens/{problem}-v0", goal="none", demonstrator=False, split="test")
    environment.action_space.seed(0)
    for episode in range(3):
        observation, info = environment.reset(seed=10_000 + episode)
        over = False
        while not over:
            observation, _reward, terminated, truncated, info = environment.step(environment.action_space.sample())
            over = terminated or truncated
        seen = (observation["height"] > 0).mean()
        print(f"seed {info['seed']}: {info['step']} steps, reward {info['total_reward']:.2f}, {seen:.0%} of the table covered")


if __name__ == "__main__":
    main()
