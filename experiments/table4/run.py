"""What each part of the method is worth: errors by spp without it (paper, Table 4).

python -m experiments.table4.train --data ../shared/data/train --output RUNS
python -m experiments.table4.run --runs RUNS
"""

import json
from pathlib import Path

import progden_jax as pd
from experiments import _common, _mixes, _training
from experiments._mixes import Mix
from experiments.table4.train import RUNS
from progden_jax import mixers

UNBOUNDED = "{}, without t-bound"


def title(name: str) -> str:
    """Of a run in the tables."""
    whole, hyphen, _ = name.partition("-")
    return f"{whole}, {RUNS[name].title}" if hyphen else RUNS[name].title


def budgets(found: dict[str, pd.NetworkMixer]) -> str:
    """The runs as a table: how long they were trained, and how they did on scenes held out of train/."""
    lines = []
    for name, mixer in found.items():
        settings = json.loads(mixer.metadata["config"])
        kept = f"{mixer.metadata['steps']} of {settings['steps']}"
        lines.append((title(name), kept, float(mixer.metadata["score"]), mixer.metadata["commit"]))
    return _common.markdown(("run", "best step", "held-out score", "commit"), lines)


def ordering(errors: _mixes.Errors, whole: str, ablations: list[str]) -> str:
    """Where a part left out makes it worse, as the paper finds, and by how much."""
    lines, spps = [], []
    for label in _mixes.METRICS:
        best = _mixes.by_spp(errors, whole, label)
        spps = [f"{s} spp" for s in best]
        for name in ablations:
            means = _mixes.by_spp(errors, name, label)
            changes = (f"{means[s] / best[s] - 1:+.2%}" for s in best)
            lines.append((label, name, *changes))
    return _common.markdown(("over the whole method's", "ablation", *spps), lines)


def main() -> None:
    parser = _mixes.parser(__doc__)
    parser.add_argument("--runs", type=Path, help="folder that experiments.table4.train wrote")
    parser.add_argument("--denoiser", default="oidn-hdr")
    arguments = parser.parse_args()
    names = _common.begin(arguments, arguments.denoiser)

    found = _training.trained(arguments.runs, RUNS)
    if missing := [name for name in RUNS if name not in found]:
        print(f"no weights of {', '.join(missing)}: run experiments.table4.train\n")
    denoiser = pd.denoisers.load(arguments.denoiser)
    wholes = {"closed form": pd.ClosedForm(), "shipped": mixers.default_for(denoiser)}
    wholes |= {title(name): mixer for name, mixer in found.items() if "-" not in name}
    groups: dict[str, list[str]] = {name: [UNBOUNDED.format(name)] for name in wholes}
    mixes = {name: Mix(mixer) for name, mixer in wholes.items()}
    mixes |= {UNBOUNDED.format(name): Mix(mixer, None) for name, mixer in wholes.items()}
    for name, mixer in found.items():
        whole = name.partition("-")[0]
        if name != whole:
            mixes[title(name)] = Mix(mixer)
            groups.setdefault(title(whole), []).append(title(name))

    series = _common.series(arguments.data, names, arguments.spp)
    errors = _mixes.measure(denoiser, mixes, series)
    if found:
        print(f"{budgets(found)}\n")
    print(f"{_mixes.summary(errors, list(mixes))}\n")
    for whole, ablations in groups.items():
        if whole in mixes:
            print(f"## {whole}\n\n{ordering(errors, whole, ablations)}\n")


if __name__ == "__main__":
    main()
