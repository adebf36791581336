"""Random actions through PettingZoo's parallel API, for two arms.

    python docs/examples/random_agents.py

Needs nothing but this package. Prints each arm's reward and how far its tip ends from its target: some 10 cm, since
nobody steers. Takes a few seconds.
"""

import sys

import surgical_marl as sm


def main(episodes: int = 3, scene: str = "bimanual_psm") -> dict[str, float]:
    """Play some episodes, and return each arm's last distance in m."""
    env = sm.parallel_env("reach", scene=scene)
    infos: dict = {}
    for agent in env.possible_agents:
        env.action_space(agent).seed(0)
    for episode in range(episodes):
        env.reset(seed=episode)
        returns = dict.fromkeys(env.agents, 0.0)
        while env.agents:  # empty once the episode is over
            actions = {agent: env.action_space(agent).sample() for agent in env.agents}
            _observations, rewards, _terminations, _truncations, infos = env.step(actions)
            for agent, reward in rewards.items():
                returns[agent] += reward
        print({agent: f"return {returns[agent]:.1f}, {1000 * infos[agent]['tip_error']:.0f} mm" for agent in returns})
    env.close()
    return {agent: info["tip_error"] for agent, info in infos.items()}


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
