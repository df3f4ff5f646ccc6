"""Stands for the simulator of paths: straight ahead at 1 m/s and, for an uncertain file, 20 % faster and bending."""

import sys
from pathlib import Path

commands, vehicle, _, out, *_ = sys.argv[1:]
if "refused" in Path(vehicle).name:
    print(f"fake: {vehicle}: is no vehicle file.", file=sys.stderr)
    sys.exit(2)
rows = [line.split(",") for line in Path(commands).read_text().splitlines()[1:]]
lines = ["path,t,x,y,yaw"]
for number, (gain, bend) in enumerate([(1.0, 0.0), (1.2, 0.3)] if "uncertain" in Path(vehicle).name else [(1.0, 0.0)]):
    x = 0.0
    for t, v, _ in rows:
        lines.append(f"{number},{t},{x * gain},{x * bend},0")
        x += 0.05 * float(v)
Path(out).write_text("\n".join(lines) + "\n")
