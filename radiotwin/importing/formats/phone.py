"""Formats of telephones: wardriving and cell monitors."""

from radiotwin.importing.formats.format import Format

FORMATS = (
    Format(
        "wigle", "WiGLE WiFi Wardriving (CSV)",
        {"level": "RSSI", "device": "MAC", "time": "FirstSeen", "latitude": "CurrentLatitude",
         "longitude": "CurrentLongitude", "altitude": "AltitudeMeters"},
        ("MAC", "FirstSeen", "RSSI", "CurrentLatitude", "CurrentLongitude"),
        "RSSI of a Wi-Fi, Bluetooth or cell beacon, dBm", "https://api.wigle.net/csvFormat.html",
        {"level_unit": "dBm", "length_unit": "m", "time_format": "%Y-%m-%d %H:%M:%S",
         "time_zone": "UTC"},
    ),
)
