"""Runs README's snippet that loads a trained team in PyTorch, and compares its messages and actions with recorded ones.

usage: act_in_pytorch.py ACTORS.safetensors STORE    (a directory that `ccmarl record --policy run:…` wrote)
"""

import re
import sys
from pathlib import Path

import pyarrow.parquet as parquet
import torch

actors_file, store = sys.argv[1], Path(sys.argv[2])
readme = Path(__file__).parents[2] / "README.md"
snippet = next(code for code in re.findall(r"```python\n(.*?)```", readme.read_text(), re.S) if "def load_team" in code)
exec(snippet)

act = load_team(actors_file)  # noqa: F821, from the snippet
rows = parquet.read_table(store / "part-00000.parquet").slice(0, 2000).to_pydict()
learners = [name.removeprefix("action.") for name in rows if name.startswith("action.")]
worst = lost = compared = 0
for t in range(len(rows["step"])):
    if rows["is_last"][t]:
        continue
    observations = [rows[f"observation.{name}"][t] for name in learners]
    link = torch.tensor(rows["link"][t]).reshape(len(learners), len(learners))
    lost += int((~link).sum())
    for name, action, message in zip(learners, act(observations, link), act.send(observations)):
        recorded = torch.tensor(rows[f"message.{name}"][t])
        assert message.shape == recorded.shape, f"message.{name} has {len(recorded)} numbers, the team sends {len(message)}"
        worst = max(worst, (message - recorded).abs().max().item())
        worst = max(worst, (action - torch.tensor(rows[f"action.{name}"][t])).abs().max().item())
        compared += 1
assert compared > 1000 and lost > 100, "the store is too small to say anything"
assert worst < 1e-6, f"an action or a message differs by {worst}"
print(f"ok torch {torch.__version__}: {compared} messages of {len(recorded)} and actions within {worst:.1e} of the recorded ones, {lost} messages lost")
