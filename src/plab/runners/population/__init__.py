"""Many agents at once: the runs of a sweep by ``sac``, ``td3`` or ``ppo``, in one simulator.

The agents of a population learn in step with each other and share nothing but the launches: parameters are
stacked, [agent, ...], and multiplied in batches. Each has environments, a replay buffer, statistics and
random numbers of its own, starts with the networks that Stable-Baselines3 would give it, and does what
Stable-Baselines3 does, update by update.
"""
