"""Programs of telephones that log cells, Wi-Fi and Bluetooth beacons."""

from radiotwin.importing.formats.format import Format
from radiotwin.importing.read_source import WithoutHeader

_UNKNOWN = 2147483647  # of Android's telephony, CellInfo.UNAVAILABLE
_MIXED = ("levels are RSRP of LTE and NR, RSCP of UMTS, RSSI of GSM: they differ by more than "
          "10 dB and are no one quantity; keep one with --only {}=LTE")

PHONE = (
    Format(
        "wigle", "WiGLE WiFi Wardriving, CSV 1.4 and 1.6",
        {"level": "RSSI", "device": "MAC", "time": "FirstSeen", "latitude": "CurrentLatitude",
         "longitude": "CurrentLongitude", "altitude": "AltitudeMeters"},
        ("MAC", "FirstSeen", "RSSI", "CurrentLatitude", "CurrentLongitude", "Type"),
        "RSSI of the beacon, dBm", "https://api.wigle.net/csvFormat.html",
        {"level_unit": "dBm", "length_unit": "m", "time_format": "%Y-%m-%d %H:%M:%S",
         "time_zone": "UTC"},
        caution="times are read as UTC, which the format's description leaves open; a shift does "
                "no harm within one telephone. Wi-Fi, Bluetooth and cells are in one file: keep "
                "one with --only Type=WIFI"),
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
        caution="times are those of the telephone: give its --time-zone. "
                + _MIXED.format("NetworkTech").replace("=LTE", "=4G")),
    Format(
        "netmonitor", "NetMonitor (Cell Signal Logging), CSV session",
        {"level": "rssi", "device": "{tech} {mcc}-{mnc}-{lac_tac}-{node_id}-{cid}",
         "time": "sys_time", "latitude": "lat", "longitude": "long"},
        ("sys_time", "net_type", "tech", "mcc", "mnc", "lac_tac", "cid", "rssi", "lat", "long"),
        "rssi: RSRP of LTE and NR, RSCP of UMTS, RSSI of GSM, dBm",
        "header as in public readers of its files; no description by its author was found",
        {"level_unit": "dBm", "time_format": "%Y%m%d%H%M%S",
         "not_measured": ["empty", "null", 0, _UNKNOWN]},
        caution="times are those of the telephone: give its --time-zone. "
                "gps = 0 is a row without a fix: --only gps=1. " + _MIXED.format("tech")),
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
        caution="times are those of the telephone: give its --time-zone. The files that are known "
                "have few rows of a network, over months: a fit needs many. Its log of cells is "
                "not known, and needs --columns"),
)
