"""What mixing gains over a kernel-predicting denoiser (paper, Table 2), shown as Table 1.

progden sweep experiments/table2/sweep.yaml -o runs/table2
python -m experiments.table2.plot runs/table2
"""

from experiments.table1 import plot as table1


def main() -> None:
    table1.main(__doc__)


if __name__ == "__main__":
    main()
