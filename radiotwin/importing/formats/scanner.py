"""Spectrum scanners."""

from radiotwin.importing.formats.format import Format
from radiotwin.importing.read_source import WithoutHeader
from radiotwin.importing.rtl_power import read_rtl_power

SCANNER = (
    Format(
        "rtl-power", "rtl_power",
        {"level": "power_db", "device": "band", "time": "{date} {time}"},
        ("date", "time", "band", "power_db", "bins"),
        "power in the band (`--band-hz`, or all of a sweep), the sum of its bins; relative dB",
        "http://kmkeen.com/rtl-power/ and csv_dbm() of rtl_power.c (osmocom rtl-sdr)",
        {"level_unit": "dBm", "time_format": "%Y-%m-%d %H:%M:%S", "not_measured": ["empty"]},
        caution="levels are relative to the receiver's full scale, not dBm: calibrate with "
                "--level-offset-db, and never compare files with different gains or bins. Times "
                "are those of the computer: give its --time-zone. Positions come from a --track",
        without_header=WithoutHeader(
            r"\d{4}-\d\d-\d\d, \d\d:\d\d:\d\d, \d+, \d+, [\d.]+, \d+, .*", read=read_rtl_power)),
)
