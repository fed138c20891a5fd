"""Text exports of drive test tools, whose columns a user chooses."""

from radiotwin.importing.formats.format import Format

DRIVE_TEST = (
    Format(
        "tems", "TEMS, text export",
        {"level": ("Serving Cell RSRP (dBm)", "LTE Serving Cell RSRP (dBm)",
                   "All-Serving Cell RSRP (dBm)"),
         "device": ("{Serving Cell DL EARFCN} {Serving Cell PCI}",
                    "{Serving Cell DL EARFCN} {Serving Physical Cell ID}", "Serving Cell PCI",
                    "Serving Physical Cell ID", "Serving Cell Identity"),
         "time": "Time", "latitude": "All-Latitude Decimal Degree",
         "longitude": "All-Longitude Decimal Degree"},
        ("Time", "All-Latitude Decimal Degree", "All-Longitude Decimal Degree"),
        "RSRP of the serving LTE cell, dBm",
        "columns as in public readers of its exports; its manual is not public",
        {"level_unit": "dBm", "not_measured": ["empty"]},
        caution="the columns of an export are chosen by its user: declare --time-format, "
                "--time-zone, and the columns that are named otherwise"),
    Format(
        "qualipoc", "QualiPoc, CSV export",
        {"level": "RSRP", "device": ("{DL EARFCN} {PCI}", "Cell Id"), "time": "Time",
         "latitude": "Latitude", "longitude": "Longitude", "altitude": "Altitude"},
        ("Time", "Data technology", "DL EARFCN", "PCI", "RSRP"),
        "RSRP of the serving cell, dBm",
        "columns as in public readers of its exports; its manual is not public",
        {"level_unit": "dBm", "length_unit": "m", "time_format": "ISO 8601",
         "not_measured": ["empty"]},
        caution="several columns have one name (RSRP, PCI, …): the first is read; give "
                "--time-zone"),
)
