"""Files and words that are wrong, each in one way, with what the message has to mention."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

HEADER = "time_s,voltage_V,current_A,speed_rad_s\n"
_RNG = np.random.default_rng(7)


@dataclass(frozen=True)
class Broken:
    """One broken input.

    `make` writes what is needed into a folder and returns the path or pattern to read; `columns` and `units`
    are written as on the command line; `says` must be in the message.
    """

    name: str
    make: Callable[[Path], str]
    says: str
    columns: str | None = None
    units: str | None = None


def rows(n: int = 30, pattern: str = "{t:.3f},{v},{i:.3f},{w:.3f}\n") -> str:
    """A motor that starts when the voltage steps up."""
    lines = []
    for k in range(n):
        t = 0.01 * k
        v = 6.0 if k > 3 else 0.0
        w = 100.0 * (1 - np.exp(-max(t - 0.03, 0.0) / 0.05))
        lines.append(pattern.format(t=t, v=v, i=(v - 0.05 * w) / 2, w=w))
    return "".join(lines)


def _file(content: str | bytes, name: str = "run.csv") -> Callable[[Path], str]:
    def make(folder: Path) -> str:
        path = folder / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return str(path)
    return make


def _mat(**variables: object) -> Callable[[Path], str]:
    def make(folder: Path) -> str:
        from scipy.io import savemat

        savemat(folder / "run.mat", variables)
        return str(folder / "run.mat")
    return make


def _folder(folder: Path) -> str:
    (folder / "empty").mkdir()
    (folder / "empty" / "notes.md").write_text("nothing here")
    return str(folder / "empty")


GOOD = HEADER + rows()

BROKEN = [
    # -- there is nothing to read
    Broken("missing file", lambda d: str(d / "nowhere.csv"), "no file"),
    Broken("missing file beside others", lambda d: (_file(GOOD)(d), str(d / "runn.csv"))[1],
           "Did you mean 'run.csv'"),
    Broken("missing folder", lambda d: str(d / "none" / "run.csv"), "does not exist"),
    Broken("pattern without a match", lambda d: str(d / "run*.csv"), "nothing matches"),
    Broken("folder without records", _folder, "holds no records"),
    Broken("empty file", _file(b""), "empty"),
    Broken("blank lines only", _file("\n\n   \n\n"), "empty"),
    Broken("zero bytes only", _file(b"\0" * 4096), "empty"),
    Broken("comments only", _file("# t,u,w\n# nothing came\n"), "only comments"),
    # -- it is no table
    Broken("prose", _file("Dear colleague,\nthe motor did not start today.\nRegards\n"),
           "rows of at least two"),
    Broken("one number per line", _file("\n".join(str(k) for k in range(50))), "at least two numbers"),
    Broken("header only", _file(HEADER), "at least two numbers"),
    Broken("binary garbage", _file(_RNG.bytes(5000)), "binary"),
    Broken("a picture", _file(b"\x89PNG\r\n\x1a\n" + _RNG.bytes(500)), "picture"),
    Broken("a spreadsheet", _file(b"PK\x03\x04" + _RNG.bytes(500)), "Excel"),
    Broken("a packed file", _file(b"\x1f\x8b" + _RNG.bytes(500)), "unpack"),
    Broken("a PDF", _file(b"%PDF-1.7\n1 0 obj\n"), "PDF"),
    Broken("a web page", _file("<html><body><p>404 not found</p></body></html>\n"),
           "rows of at least two"),
    Broken("JSON of arrays", _file(json.dumps({"slow": [[0.01 * k, 1.5 * k, 2.5] for k in range(40)]}, indent=2)),
           "it is JSON, not a table"),
    Broken("JSON lines", _file("".join(f'{{"t": {k}, "v": {k % 5}, "omega": {k}}}\n' for k in range(40))),
           "it is JSON, not a table"),
    Broken("JSON", _file('{"t": [0, 1, 2], "v": [1, 2, 3]}\n'), "it is JSON, not a table"),
    Broken("serial chatter", _file("".join(f"RPM: {k} Temp: warm\n" for k in range(40))),
           "rows of at least two"),
    Broken("decimal and separating comma", _file(HEADER + "0,00,6,0,1,5,2,5\n" * 30), "semicolon"),
    Broken("fewer names than values", _file("time_s;voltage_V\n" + "0;1;2;3\n" * 20), "2 names"),
    Broken("open quotation mark", _file(GOOD + '0.5,6,"1.0,99\n' + rows()), "cannot be read as a table"),
    Broken("quotation over two lines", _file(GOOD + '0.5,6,"1\n2",1,1,1\n'), "cannot be read as a table"),
    Broken("quotation over the first lines", _file(HEADER + '0,6,"1\n2",1,1,1\n' + rows()), "loss of data"),
    # -- the columns are not clear
    Broken("no header", _file(rows()), "by position"),
    Broken("no time", _file(GOOD.replace("time_s", "sample")), "the time (t)"),
    Broken("no voltage", _file(GOOD.replace("voltage_V", "temp_C")), "the drive voltage (v)"),
    Broken("duty cycle without supply", _file(GOOD.replace("voltage_V", "duty")), "duty cycle"),
    Broken("nothing measured", _file("time_s,voltage_V\n" + rows(pattern="{t},{v}\n")),
           "measured current"),
    Broken("two speeds", _file(GOOD.replace("current_A", "speed_2_rad_s").replace(",speed_rad",
           ",speed_1_rad")),
           "say which one"),
    Broken("unknown column", _file(GOOD), "Did you mean 'voltage_V'", columns="v=voltage"),
    Broken("position out of range", _file(GOOD), "unknown column", columns="t=9"),
    Broken("unknown channel", _file(GOOD), "unknown channel 'torque'", columns="torque=current_A"),
    Broken("one column for two channels", _file(GOOD),
           "each needs its own", columns="v=voltage_V,omega=voltage_V",
           units="omega=rpm"),
    Broken("swapped columns", _file(GOOD), "right column", columns="t=voltage_V,v=time_s"),
    Broken("speed for time", _file(rows(40, "{v},{t:.3f},{i:.3f}\n")),
           "right column", columns="t=1,v=2,i=3"),
    # -- the units are not clear
    Broken("unknown unit", _file(GOOD), "Did you mean 'rpm'", units="omega=rpmm"),
    Broken("unit of another quantity", _file(GOOD), "that is a voltage", units="omega=mV"),
    Broken("unit for an absent channel", _file(GOOD), "units for 'theta'", units="theta=deg"),
    Broken("unit for an unknown name", _file(GOOD), "Did you mean 'omega'", units="omga=rpm"),
    Broken("counts without their number", _file(GOOD.replace("speed_rad_s",
           "encoder").replace("current_A", "x")),
           "counts:2048"),
    Broken("counts per turn of zero", _file(GOOD.replace("speed_rad_s", "theta")), "positive number",
           units="theta=counts:0"),
    Broken("angle in m and speed in rad/s", _file(GOOD.replace("current_A", "position_m")),
           "does not go with"),
    # -- the samples are of no use
    Broken("one row", _file(HEADER + "0,6,1,0\n"), "at least 8 samples"),
    Broken("seven rows", _file(HEADER + rows(7)), "at least 8 samples"),
    Broken("time stands still", _file(HEADER + rows(30, "0.5,{v},{i:.3f},{w:.3f}\n")),
           "time does not move"),
    Broken("time runs backwards", _file(HEADER + "".join(f"{9 - 0.1 * k},6,1,{k}\n" for k in range(50))),
           "time does not increase"),
    Broken("time is not given", _file(HEADER + rows(30, "nan,{v},{i:.3f},{w:.3f}\n")),
           "0 rows of 30 hold a time"),
    Broken("time is words", _file(HEADER + rows(30, "soon,{v},{i:.3f},{w:.3f}\n")),
           "neither numbers nor dates"),
    Broken("everything missing", _file(HEADER + rows(30, "{t:.3f},nan,nan,nan\n")), "missing"),
    Broken("nothing measured is there", _file(HEADER + rows(30, "{t:.3f},{v},nan,nan\n")),
           "nothing measured"),
    Broken("voltage missing", _file(HEADER + rows(30, "{t:.3f},,{i:.3f},{w:.3f}\n")),
           "'voltage_V' is missing"),
    Broken("infinite everywhere", _file(HEADER + rows(30, "{t:.3f},{v},inf,-inf\n")), "missing"),
    Broken("speed in words", _file(HEADER + rows(30, "{t:.3f},{v},{i:.3f},fast\n")),
           "holds text, e.g. 'fast'"),
    # -- other formats
    Broken("MATLAB file without numbers", _mat(a="hello", b=3.0), "no numeric arrays"),
    Broken("MATLAB file of complex numbers", _mat(t=np.arange(30) * 1j), "no numeric arrays"),
    Broken("MATLAB file without a header word", _mat(a=np.arange(30.0), b=np.arange(30.0)),
           "no column looks like"),
    Broken("damaged MATLAB file", _file(b"MATLAB 5.0 MAT-file" + _RNG.bytes(400), "run.mat"), "MATLAB"),
    Broken("MATLAB 7.3 file", _file(b"MATLAB 7.3 MAT-file, Platform" + b" " * 200, "run.mat"), "-v7"),
    Broken("empty MATLAB file", _file(b"", "run.mat"), "cannot be read as a MATLAB file"),
    Broken("damaged Parquet file", _file(b"PAR1" + _RNG.bytes(300), "run.parquet"),
           "cannot be read as Parquet"),
    Broken("MATLAB file called CSV", _file(b"MATLAB 5.0 MAT-file" + _RNG.bytes(400)), ".mat"),
]
