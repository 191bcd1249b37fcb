"""Whether an installed package works, without anything beside it: the release runs this with each wheel that it has built."""

import tempfile
from pathlib import Path

import cantap

DBC = 'VERSION ""\nBU_: A\nBO_ 291 Engine: 8 A\n SG_ Speed : 0|8@1+ (0.5,0) [0|127] "km/h" A\n'

with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    (folder / "car.dbc").write_text(DBC)
    (folder / "drive.log").write_text("".join(f"({at}.000000) can0 123#{at:02X}\n" for at in range(100)))
    for suffix in ("blf", "mf4", "asc", "parquet"):
        made = folder / f"drive.{suffix}"
        cantap.write(cantap.read(folder / "drive.log"), made)
        assert cantap.decode(made, folder / "car.dbc")["Engine"]["Speed"].to_list() == [at / 2 for at in range(100)], suffix
with cantap.open("virtual:car", 500_000) as device:
    assert device.read(10) is not None
print(f"cantap {cantap.__version__} works")
