"""From the bench: record a motor over a serial port, or a virtual one without hardware.

`record` is what one calls; `protocol` says what a device has to speak, `excitation` what it can be asked to apply,
`virtual` is a device made of software. This package is the only importer of pyserial, and only when a port opens."""

from motorid.acquire.excitation import Program, program
from motorid.acquire.recorder import record
from motorid.acquire.session import Progress, Recording

__all__ = ["Program", "Progress", "Recording", "program", "record"]
