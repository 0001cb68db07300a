"""Entries as version 1 of the format wrote them: frames as they are, magic TCH1; zlib in base 64."""

import base64
import zlib

SEQUENCE = zlib.decompress(
    base64.b64decode(
        "eNp9kVl60zAUhZ0wl3mewRUzOEF27DQthRZKocxTmVqMkW3FVuupktySr2QrrIEFsQAe2QFITvjAAWI/WLr3nP8eyfMzc3pr5PO3r1VF"
        "WQfLJPHBhAoYXslx4mGgqSCLEElEUXRxp/im7hL2uEMKaX8DpZQRjkUNimWccpJKG8goZkx2OSUoku2ulOKEpVT2AxwxEoTciUlCCgru"
        "C/urWsH2UERcin5Re6UYU1RECnoZDVFdC3spFvW6CALrli3neWnCkchJcSAITvaxUGjS0dBU05aRYyfDtNeCddhsmNKIKEUdJtXrIBED"
        "5fA2FYviTCxEWTFMcExNtQRNonzeKcrgU64DQflt9XHGQyeOB81G38nEOWVNr1uG1RprjcOmYeEatP6kThKjTF0Vl+P/D+kSLvNzmuOh"
        "0dop9bCTDGJKscS9QDg+1rREqqGJwpRxh5NYAAcuyi77WmVfFiKGhxj+Th2hYOiE3ARdu6tUqhs2btq8Zeu2ke07du7avWfvvv0HDh46"
        "fOToseMnTp46rY6CM2fPnb9w8dLlK1qtfhXqRsO0muIHTFybvH5javrmrZnbs3fuzt27/+Dho8dPnj57/mL+5avXb94uLL6z3zsfkOv5"
        "uB2EZGk5ipM0W6GM56tryvS/3x/flcHnS2m34Fblp1Ipi34CAMv4oA=="
    )
)
"""Object 0 of `fakes`: two frames of 4 × 5 px whose bytes count up, depth 0.25 mm."""

CARD = zlib.decompress(
    base64.b64decode(
        "eNrtjjFuhEAMRUmbXCEFmpoik3Rpt8kBtkMIGRgFZ70zyOMhQoS7Z4xQlBNste7+8//+Pp8+bNn0T88PRbGaC/rBvJcmdF+uF1OVZiJA"
        "n9F6sBb/GVqrljgRikJh9WZC0DmKe2oEHryLKmzecEif46Ff9TwH4RQxaMdLBlcQxwik/i1r8D4ISGAt8KELw6INM8YE1BI6veQTUaX9"
        "SUZt1aCHq9OM2a8ww6LOev1bzOi+9/dHmBTUNvfb/NRbk+kgy07NT7Jma7bH+9xkfgFTR2dX"
    )
)
"""Card 1 of `fakes` without the depth of its view."""
