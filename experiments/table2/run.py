"""What mixing gains over a kernel-predicting denoiser (paper, Table 2); options as of table1.

python -m experiments.table2.run [--denoisers NAME_OR_FILE ...] [--mixers NAME_OR_FILE ...]
"""

from experiments.table1 import run as table1

DENOISERS = ("kpcn-hdr-alb-nrm-var",)


def main() -> None:
    table1.main(__doc__, DENOISERS)


if __name__ == "__main__":
    main()
