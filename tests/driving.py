"""Steps of environments of missions."""

import torch


def act(env, data, action):
    """Let all missions act alike; return what that leads to."""
    size = env.full_action_spec_unbatched["action"].shape[-1]
    data["action"] = torch.as_tensor(action, dtype=env.dtype).expand(*data.batch_size, size)
    return env.step(data)["next"]


def drive(env, data, actions):
    """Take one action after another; return what each step leads to."""
    record = []
    for action in actions:
        record.append(act(env, data, action).clone())
        data = env.step_mdp(data)
    return torch.stack(record)
