"""Known formats of logs: how they are recognised, and the mapping of their columns.

Most are tables. A sweep of rtl_power has a line for each tuning (`date, time, Hz low, Hz high, Hz
step, samples, dB, dB, …`), with the last bin twice; the power of its bins in a band is summed.
"""

import io
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.importing.log_files import Lines, LogFile
from radiotwin.importing.read_source import Expected, WithoutHeader
from radiotwin.importing.settings import Settings
from radiotwin.importing.source import Source, columns_of
from radiotwin.io.budgets import CELLS, COLUMNS, ROWS

_FIRST = 6  # fields before the bins
_NO_LEVEL = re.compile(r"-?(1\.#|nan|inf)", re.IGNORECASE)
"""Of a bin without power; `-1.#J` and `-1.#IND` are those of Windows."""
_EDGE = 1e-6  # tolerance of band edges, in bin widths
SEMTECH = "Semtech, SX1276/77/78/79 data sheet, rev. 4, 5.5.5"
_LEVEL = "power of the packet, dBm: RSSI, plus SNR where that is below 0"
_CAUTION = ("the RSSI of a packet below the noise is mostly noise, so level = RSSI + SNR where SNR "
            f"is below 0 ({SEMTECH}; at SNR = 0 the packet alone has 3 dB less). Packets that a "
            "gateway did not hear are not in the file")
_MAPPER = (_CAUTION + ". Devices are the gateways, the receiver is the node that moves: the gain "
           "is that of both directions, and the level is that of the node's transmitter")
_STACK = "https://www.thethingsindustries.com/docs/the-things-stack/concepts/data-formats/"
_CHIRPSTACK = "https://docs.rs/crate/chirpstack_api (integration.proto, gw.proto; JSON of proto3)"
_UNITS = {"level_unit": "dBm", "length_unit": "m", "time_format": "ISO 8601"}
_GATEWAYS = {**_UNITS, "read_at": "device"}
_TELEPHONE = "times are those of the telephone: give its --time-zone"
_UNKNOWN = 2147483647  # of Android's telephony, CellInfo.UNAVAILABLE
_MIXED = ("levels are RSRP of LTE and NR, RSCP of UMTS, RSSI of GSM: they differ by more than "
          "10 dB and are no one quantity; keep one with --only {}=LTE")


def _read_rtl_power(file: LogFile, settings: Settings) -> Source:
    """Sum the power [dB] of each sweep of rtl_power, in the band of the settings or in all bins.

    Bins with their centre in the band count; of wider ones that with the band's middle, after
    whose edges the band is named. `power_db` is empty if a sweep does not cover the band.
    """
    band_hz = settings.band_hz
    sweeps: list[list[str]] = []
    numbers: list[int] = []
    low_hz = power = 0.0
    high_hz, bins, cells = 0.0, 0, 0
    all_hz, edges_hz = [np.inf, -np.inf], [np.inf, -np.inf]

    def finish() -> None:
        covered = bins and (band_hz is None or (low_hz <= band_hz[0] and high_hz >= band_hz[1]))
        level = f"{10 * np.log10(power):.4f}" if covered and power > 0 else ""
        sweeps[-1][2:] = [level, str(bins)]

    with file.open() as content, io.TextIOWrapper(content, "ascii", "replace", newline="") as text:
        lines = Lines(text, file)
        for line in lines:
            fields = [field.strip() for field in line.split(",")]
            if fields == [""]:
                continue
            COLUMNS.check(len(fields), f"{file}: line {lines.number}")
            cells += len(fields)
            CELLS.check(cells, file)
            centre_hz, db, step_hz = _bins(file, lines.number, fields)
            if not sweeps or sweeps[-1][:2] != fields[:2]:
                if sweeps:
                    finish()
                ROWS.check(len(sweeps) + 1, file)
                sweeps.append(fields[:2])
                numbers.append(lines.number)
                low_hz, high_hz, power, bins = np.inf, -np.inf, 0.0, 0
            margin_hz = step_hz * (0.5 + _EDGE)
            low_hz = min(low_hz, centre_hz[0] - margin_hz)
            high_hz = max(high_hz, centre_hz[-1] + margin_hz)
            all_hz = [min(all_hz[0], low_hz), max(all_hz[1], high_hz)]
            inside = np.ones(len(db), dtype=bool)
            if band_hz is not None:
                inside = (centre_hz >= band_hz[0]) & (centre_hz <= band_hz[1])
                if band_hz[1] - band_hz[0] < step_hz:  # the bin that has its middle
                    offset_hz = (band_hz[0] + band_hz[1]) / 2 - centre_hz + step_hz / 2
                    inside = (offset_hz >= 0) & (offset_hz < step_hz)
                if inside.any():
                    edges_hz = [min(edges_hz[0], centre_hz[inside][0] - step_hz / 2),
                                max(edges_hz[1], centre_hz[inside][-1] + step_hz / 2)]
            power += float((10 ** (db[inside] / 10)).sum())  # NaN where a bin was not measured
            bins += int(inside.sum())
    if not sweeps:
        raise BadInput(f"{file} is empty")
    finish()
    named_hz = band_hz or all_hz
    if band_hz and edges_hz[1] - edges_hz[0] > 1.5 * np.ptp(band_hz):  # a bin is wider than it
        named_hz = edges_hz
    name = f"{named_hz[0] / 1e6:.6g}-{named_hz[1] / 1e6:.6g} MHz"
    if all(int(sweep[3]) == 0 for sweep in sweeps):
        raise BadInput(f"{file}: no bin lies in the band {name} (band_hz); the file has "
                       f"{all_hz[0] / 1e6:.6g} to {all_hz[1] / 1e6:.6g} MHz")
    table = pd.DataFrame([[date, time, name, level, count] for date, time, level, count in sweeps],
                         columns=["date", "time", "band", "power_db", "bins"], dtype=str)
    return Source(str(file), table, lambda index: f"line {numbers[index]}")


def _bins(file: LogFile, number: int, fields: list[str]) -> tuple[np.ndarray, np.ndarray, float]:
    """Parse a line of rtl_power: centres [Hz] and levels [dB] of its bins, and their width [Hz]."""
    try:
        low_hz, high_hz, step_hz = map(float, fields[2:5])
        levels = fields[_FIRST:] if fields[-1] else fields[_FIRST:-1]
        db = np.array([np.nan if _NO_LEVEL.match(each) else float(each) for each in levels])
        count = round((high_hz - low_hz) / step_hz)
    except (ValueError, ZeroDivisionError, OverflowError):
        count = 0
    if not 0 < count <= len(db) <= count + 1:
        raise BadInput(f"{file}: line {number} is none of rtl_power: date, time, Hz low, Hz high, "
                       "Hz step, samples, and a level for each step")
    return low_hz + step_hz * (np.arange(count) + 0.5), db[:count], step_hz


@dataclass(frozen=True)
class Format:
    """A known format of logs.

    Attributes:
        name: for the option `--format`.
        title: program that writes the format.
        columns: quantity of `Columns` -> column or template; of several, the first one whose
            columns the file has. Upper and lower case are equal, `*` matches any text.
        signature: columns by which a file is recognised.
        needs: quantities that a file must have besides.
        level: meaning of the level, with its unit.
        source: of this description.
        settings: further settings of the import.
        caution: printed at every import.
        zone_caution: printed if no time zone is declared.
        without_header: how a file without a header is recognised and read, or None.
    """

    name: str
    title: str
    columns: Mapping[str, str | tuple[str, ...]]
    signature: tuple[str, ...]
    level: str
    source: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    caution: str = ""
    zone_caution: str = ""
    without_header: WithoutHeader | None = None
    needs: tuple[str, ...] = ()

    def fits(self, header: Iterable[str]) -> bool:
        """Return whether a header has the signature and the needed quantities."""
        names = list(header)
        return set(map(_plain, self.signature)) <= set(map(_plain, names)) and (
            not self.needs or set(self.needs) <= set(self.mapping(names)))

    def mapping(self, header: Iterable[str]) -> dict[str, str]:
        """Return quantity -> column for each quantity of this format that a header has."""
        actual = {_plain(name): name for name in reversed(list(header))}  # the first one counts
        result = {}
        for quantity, entries in self.columns.items():
            for entry in (entries,) if isinstance(entries, str) else entries:
                columns = {name: _matching_column(_plain(name), actual)
                           for name in columns_of(entry, ())}
                if all(columns.values()):
                    for name, found in columns.items():
                        entry = entry.replace(name, found)
                    result[quantity] = entry
                    break
        return result


def _plain(name: str) -> str:
    """Return a column name in lower case without a suffix such as `[1]` or `(Text)`."""
    return re.sub(r"(\s*(\(text\)|\[\d+\]))+$", "", name.strip().lower())


def _matching_column(name: str, actual: Mapping[str, str]) -> str:
    """Return the first column, of plain -> actual name, that fits a name with `*`; or `""`."""
    if "*" not in name:
        return actual.get(name, "")
    pattern = re.compile(".*".join(map(re.escape, name.split("*"))))
    return next((actual[each] for each in reversed(list(actual)) if pattern.fullmatch(each)), "")


def _node_position_columns(payload: str) -> dict[str, str | tuple[str, ...]]:
    """Return quantity -> usual column names of a node's position in the fields of a payload."""
    return {quantity: tuple(f"{payload}{each}" for short in (long, *others)
                            for each in ((f"*{short}",) if short == long else
                                         (short, f"*.{short}")))
            for quantity, long, others in (("latitude", "latitude", ("lat",)),
                                           ("longitude", "longitude", ("lng", "lon", "long")),
                                           ("altitude", "altitude", ("alt",)))}


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


def _lora(name: str, title: str, source: str, payload: str, place: str,
          settings: Mapping[str, Any] = _UNITS, **columns: str | tuple[str, ...]
          ) -> tuple[Format, Format]:
    """Return formats of a LoRa network's uplinks, for nodes that send a position and others.

    `payload` and `place` are prefixes of columns: of the decoded payload, and of a gateway's
    position. `columns` are those of `level`, `snr`, `time`, `node` and `gateway`.
    """
    node, gateway = str(columns.pop("node")), str(columns.pop("gateway"))
    places = {each: f"{place}{each}" for each in ("latitude", "longitude", "altitude")}
    if not place.endswith("."):  # Helium
        places = {"latitude": f"{place}.lat", "longitude": f"{place}.long"}
    signature = (str(columns["level"]), gateway, node)
    return (
        Format(f"{name}-mapper", f"{title}, of a node that sends its position (JSON lines)",
               {**columns, "device": gateway, "receiver": node, **_node_position_columns(payload),
                **{f"device_{each}": entry for each, entry in places.items()}},
               signature, _LEVEL, source, {**settings, "read_at": "device"}, caution=_MAPPER,
               needs=("latitude", "longitude")),
        Format(name, f"{title} (JSON lines)",
               {**columns, "device": node, "receiver": gateway, **places},
               signature, _LEVEL, source, settings, caution=_CAUTION))


def _things_stack(prefix: str) -> tuple[Format, Format]:
    """Return the formats of The Things Stack's uplink messages, with a prefix of their fields."""
    message, gateway = f"{prefix}uplink_message.", f"{prefix}uplink_message.rx_metadata."
    return _lora(
        "things-stack" + "-storage" * bool(prefix),
        "The Things Stack, uplink messages" + ", storage integration" * bool(prefix), _STACK,
        payload=message + "decoded_payload.", place=gateway + "location.",
        level=gateway + "rssi", snr=gateway + "snr",
        time=(message + "received_at", prefix + "received_at"),
        node=f"{prefix}end_device_ids.device_id", gateway=gateway + "gateway_ids.gateway_id")


LORA = (
    Format(
        "ttn-mapper", "TTN Mapper, CSV export",
        {"level": "rssi", "snr": "snr", "device": ("gwaddr", "gtw_id", "gateway_id"),
         "receiver": ("nodeaddr", "dev_id", "device_id"), "time": "time", "latitude": "lat",
         "longitude": "lon", "altitude": "alt"},
        ("time", "snr", "rssi", "freq", "lat", "lon", "alt", "hdop", "sats", "provider"),
        _LEVEL,
        "https://ttnmapper.org, export of a user; header and two rows quoted in a public README",
        {**_GATEWAYS, "time_zone": "UTC"},
        caution=_MAPPER + ". alt may be 0 where the node has no height",
        zone_caution="times are taken for UTC"),
    *_things_stack(""),
    *_things_stack("result."),
    *_lora("chirpstack", "ChirpStack 4, uplink events", _CHIRPSTACK, payload="object.",
           place="rxInfo.location.", level="rxInfo.rssi", snr="rxInfo.snr", time="time",
           node="deviceInfo.devEui", gateway="rxInfo.gatewayId"),
    *_lora("chirpstack-3", "ChirpStack 3, uplink events",
           _CHIRPSTACK.replace("api (", "api/3.8.1 ("), payload="object.",
           place="rxInfo.location.", level="rxInfo.rssi",
           snr="rxInfo.loRaSNR", time=("publishedAt", "rxInfo.time"), node="devEUI",
           gateway="rxInfo.gatewayID"),
    *_lora("helium", "Helium Console, uplinks",
           "https://docs.helium.com/console/integrations/json-schema",
           payload="decoded.payload.", place="hotspots",
           settings={**_UNITS, "time_format": "epoch ms"}, level="hotspots.rssi",
           snr="hotspots.snr", time="reported_at", node="dev_eui", gateway="hotspots.name"),
    Format(
        "semtech-udp", "Semtech UDP packet forwarder, rxpk (JSON lines)",
        {"level": "rxpk.rssi", "snr": "rxpk.lsnr", "time": "rxpk.time"},
        ("rxpk.rssi", "rxpk.freq", "rxpk.datr", "rxpk.tmst"),
        _LEVEL, "https://github.com/Lora-net/packet_forwarder/blob/master/PROTOCOL.TXT", _UNITS,
        caution=_CAUTION + ". The node's address is within the packet: name it by "
                           "--columns 'device=always NAME', and the gateway's place by "
                           "--receivers"),
)


PHONE = (
    Format(
        "wigle", "WiGLE WiFi Wardriving, CSV 1.4 and 1.6",
        {"level": "RSSI", "device": "MAC", "time": "FirstSeen", "latitude": "CurrentLatitude",
         "longitude": "CurrentLongitude", "altitude": "AltitudeMeters"},
        ("MAC", "FirstSeen", "RSSI", "CurrentLatitude", "CurrentLongitude", "Type"),
        "RSSI of the beacon, dBm", "https://api.wigle.net/csvFormat.html",
        {"level_unit": "dBm", "length_unit": "m", "time_format": "%Y-%m-%d %H:%M:%S",
         "time_zone": "UTC"},
        caution="Wi-Fi, Bluetooth and cells are in one file: keep one with --only Type=WIFI",
        zone_caution="times are read as UTC, which the format's description leaves open; a shift "
                     "does no harm within one telephone"),
    Format(
        "tower-collector", "Tower Collector, CSV export",
        {"level": "dbm", "device": "{net_type} {mcc}-{mnc}-{lac}-{cell_id}", "time": "measured_at",
         "latitude": "lat", "longitude": "lon", "altitude": "altitude", "receiver": "device"},
        ("mcc", "mnc", "lac", "cell_id", "dbm", "lat", "lon", "measured_at", "net_type"),
        "dbm of Android: RSRP, RSCP or RSSI by net_type, dBm",
        "https://github.com/zamojski/TowerCollector (CsvExportFormatter)",
        {"level_unit": "dBm", "length_unit": "m", "time_format": "ISO 8601",
         "not_measured": ["empty", _UNKNOWN]},
        caution=_MIXED.format("net_type")),
    Format(
        "cellmapper", "CellMapper, CSV output of the app",
        {"level": "signal", "device": "{type} {MCC}-{MNC}-{LAC}-{CID}", "latitude": "latitude",
         "longitude": "longitude", "altitude": "altitude"},
        ("latitude", "longitude", "altitude", "MCC", "MNC", "LAC", "CID", "signal", "type",
         "subtype", "ARFCN"),
        "RSSI, or RSRP of LTE, dBm", "https://docs.cellmapper.net/mw/CellMapper_CSV",
        {"level_unit": "dBm", "length_unit": "m", "not_measured": ["empty", _UNKNOWN]},
        caution="it has no times. " + _MIXED.format("type"),
        without_header=WithoutHeader(
            r"-?\d+\.\d+,-?\d+\.\d+,-?[\d.]*,\d{3},\d{1,3},-?\d+,-?\d+,-?\d+,"
            r"(GSM|UMTS|CDMA|LTE|NR),[^,]*,-?\d*,-?\d*",
            ("latitude", "longitude", "altitude", "MCC", "MNC", "LAC", "CID", "signal", "type",
             "subtype", "ARFCN", "PSC"))),
    Format(
        "g-nettrack", "G-NetTrack, text log",
        {"level": "Level", "device": ("{NetworkTech} {CGI}", "{NetworkTech} {Node} {CellID}"),
         "time": "Timestamp", "latitude": "Latitude", "longitude": "Longitude",
         "altitude": "Altitude"},
        ("Timestamp", "Latitude", "Longitude", "NetworkTech", "Level", "Qual", "CGI"),
        "Level: RSRP of 4G and 5G, RSCP of 3G, RXLEV of 2G, dBm",
        "https://gyokovsolutions.com/g-nettrack/; columns as in public readers of its logs",
        {"level_unit": "dBm", "length_unit": "m", "time_format": "%Y.%m.%d_%H.%M.%S",
         "not_measured": ["empty", _UNKNOWN]},
        caution=_MIXED.format("NetworkTech").replace("=LTE", "=4G"), zone_caution=_TELEPHONE),
    Format(
        "netmonitor", "NetMonitor (Cell Signal Logging), CSV session",
        {"level": "rssi", "device": "{tech} {mcc}-{mnc}-{lac_tac}-{node_id}-{cid}",
         "time": "sys_time", "latitude": "lat", "longitude": "long"},
        ("sys_time", "net_type", "tech", "mcc", "mnc", "lac_tac", "cid", "rssi", "lat", "long"),
        "rssi: RSRP of LTE and NR, RSCP of UMTS, RSSI of GSM, dBm",
        "header as in public readers of its files; no description by its author was found",
        {"level_unit": "dBm", "time_format": "%Y%m%d%H%M%S",
         "not_measured": ["empty", "null", 0, _UNKNOWN]},
        caution="gps = 0 is a row without a fix: --only gps=1. " + _MIXED.format("tech"),
        zone_caution=_TELEPHONE),
    Format(
        "g-mon", "G-MoN, text log of Wi-Fi networks",
        {"level": "RXL", "device": "BSSID", "time": "{Date} {Time}", "latitude": "LAT",
         "longitude": "LON"},
        ("BSSID", "LAT", "LON", "SSID", "Crypt", "Beacon Interval", "Connection Mode", "Channel",
         "RXL", "Date", "Time"),
        "RXL of the network, dBm",
        "header and rows as in public readers of its files; no description by its author was found",
        {"level_unit": "dBm", "time_format": "%Y/%m/%d %H:%M:%S",
         "not_measured": ["empty", "?"]},
        caution="the files that are known have few rows of a network, over months: a fit needs "
                "many. Its log of cells is not known, and needs --columns",
        zone_caution=_TELEPHONE),
)


SCANNER = (
    Format(
        "rtl-power", "rtl_power, rx_power, hackrf_sweep, soapy_power",
        {"level": "power_db", "device": "band", "time": "{date} {time}"},
        ("date", "time", "band", "power_db", "bins"),
        "power in the band (`--band-hz`, or all of a sweep), the sum of its bins; relative dB",
        "http://kmkeen.com/rtl-power/ and csv_dbm() of rtl_power.c (osmocom rtl-sdr)",
        {"level_unit": "dBm", "time_format": "%Y-%m-%d %H:%M:%S", "not_measured": ["empty"]},
        caution="levels are relative to the receiver's full scale, not dBm: calibrate with "
                "--level-offset-db, and never compare files with different gains or bins. "
                "Positions come from a --track",
        zone_caution="times are those of the computer: give its --time-zone",
        without_header=WithoutHeader(
            r"\d{4}-\d\d-\d\d, *\d\d:\d\d:\d\d(\.\d+)?(, *[\d.]+){4}, *.*",
            read=_read_rtl_power)),
)


FORMATS: tuple[Format, ...] = (*PHONE, *DRIVE_TEST, *LORA, *SCANNER)


def expected(formats: Iterable[Format], columns: Collection[str]) -> Expected:
    """Return the column names by which to find the header of a file.

    They are the declared `columns`, and those that each format needs, in lower case.
    """
    formats = list(formats)
    signatures = [frozenset(name.lower() for name in each.signature) for each in formats]
    return Expected((frozenset(columns), *signatures),
                    tuple(each.without_header for each in formats if each.without_header))


def find_format(header: Iterable[str]) -> Format | None:
    """Return the format with the longest signature in a header, or None."""
    names = list(header)
    return max((each for each in FORMATS if each.fits(names)),
               key=lambda each: len(each.signature) + len(each.needs), default=None)


def format_named(name: str) -> Format:
    """Return a format by its name; BadInput if it is unknown."""
    for each in FORMATS:
        if each.name == name:
            return each
    raise BadInput(f"format {name!r} is unknown; allowed are "
                   f"{', '.join(each.name for each in FORMATS)}")
