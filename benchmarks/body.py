"""The body in figures: cost of a pose beside another library, volume kept by bends, measures asked and read.

    python -m benchmarks.body                        # all three tables, about ten minutes
    python -m benchmarks.body --people 40            # fewer people under the tape

The parts also run by themselves: `benchmarks.body_pose` (speed and volume), `benchmarks.body_tape`, and
`benchmarks.body_people`, which needs naked people of another model to fit. The other library is body-models
(`pip install "bodyhull[bodies]"`); without it its column says so.
"""

from __future__ import annotations

import argparse

from benchmarks.body_pose import print_speed_table, print_volume_table
from benchmarks.body_tape import print_measures
from benchmarks.hull import machine


def main() -> None:
    parser = argparse.ArgumentParser(description="The free body in figures.")
    parser.add_argument("--people", type=int, default=200, help="of each sex, under the tape")
    parser.add_argument("--repetitions", type=int, default=40, help="of each timing")
    options = parser.parse_args()
    print(machine())
    print_speed_table(options.repetitions)
    print_volume_table()
    print_measures(options.people)


if __name__ == "__main__":
    main()
