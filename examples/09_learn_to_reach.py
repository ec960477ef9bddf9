"""Train SAC with hindsight experience replay (HER) to reach goals with a Koch v1.1.

Prints the success rate on the same 50 test goals during the training. It needs
``pip install "robot-ik-testbed[gym]" stable-baselines3``.
"""

import argparse
from pathlib import Path

import gymnasium

from robot_ik.gym import MAX_STEPS


def success_rate(model, env, episodes=50):
    """Return the share of episodes that end at the goal."""
    successes = 0
    for seed in range(episodes):
        observation, info = env.reset(seed=10_000 + seed)
        for _ in range(MAX_STEPS):
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            if info["is_success"] or terminated or truncated:
                break
        successes += info["is_success"]
    return successes / episodes


def main():
    from stable_baselines3 import SAC, HerReplayBuffer  # large, and only this script needs it

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=10_000, help="steps of the training")
    parser.add_argument("--every", type=int, default=1000, help="steps between two tests")
    parser.add_argument("--curve", type=Path, help="CSV file of the success rates")
    options = parser.parse_args()
    env = gymnasium.make("robot_ik/Reach-v0", robot="koch_v11")
    test_env = gymnasium.make("robot_ik/Reach-v0", robot="koch_v11")
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        learning_starts=500,
        learning_rate=1e-3,
        gamma=0.95,  # an episode has 50 steps
        seed=0,
    )
    rows = ["steps,success"]
    for trained in range(0, options.steps + 1, options.every):
        if trained:
            model.learn(options.every, reset_num_timesteps=False)
        rate = success_rate(model, test_env)
        rows.append(f"{trained},{rate}")
        print(f"after {trained} steps: {rate:.0%} of the goals", flush=True)
        if options.curve:
            options.curve.write_text("\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
