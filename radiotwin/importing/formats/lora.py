"""LoRa: gateways that receive the packets of a node."""

from radiotwin.importing.formats.format import Format

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


def _things_stack(prefix: str) -> tuple[Format, Format]:
    """Return the formats of uplink messages, for nodes with and without a position."""
    message, gateway = f"{prefix}uplink_message.", f"{prefix}uplink_message.rx_metadata."
    node = f"{prefix}end_device_ids.device_id"
    decoded = message + "decoded_payload."
    common: dict[str, str | tuple[str, ...]] = {
        "level": gateway + "rssi", "snr": gateway + "snr",
        "time": (message + "received_at", prefix + "received_at")}
    name = "things-stack" + "-storage" * bool(prefix)
    title = "The Things Stack, uplink messages" + ", storage integration" * bool(prefix)
    return (
        Format(
            f"{name}-mapper", f"{title}, of a node that sends its position (JSON lines)",
            {**common, "device": gateway + "gateway_ids.gateway_id", "receiver": node,
             "latitude": decoded + "latitude", "longitude": decoded + "longitude",
             "altitude": decoded + "altitude",
             "device_latitude": gateway + "location.latitude",
             "device_longitude": gateway + "location.longitude",
             "device_altitude": gateway + "location.altitude"},
            (gateway + "rssi", gateway + "gateway_ids.gateway_id", node, decoded + "latitude",
             decoded + "longitude"),
            _LEVEL, _STACK, _UNITS, caution=_MAPPER),
        Format(
            name, f"{title} (JSON lines)",
            {**common, "device": node, "receiver": gateway + "gateway_ids.gateway_id",
             "latitude": gateway + "location.latitude",
             "longitude": gateway + "location.longitude",
             "altitude": gateway + "location.altitude"},
            (gateway + "rssi", gateway + "gateway_ids.gateway_id", node),
            _LEVEL, _STACK, _UNITS, caution=_CAUTION))


LORA = (
    Format(
        "ttn-mapper", "TTN Mapper, CSV export",
        {"level": "rssi", "snr": "snr", "device": ("gwaddr", "gtw_id", "gateway_id"),
         "receiver": ("nodeaddr", "dev_id", "device_id"), "time": "time", "latitude": "lat",
         "longitude": "lon", "altitude": "alt"},
        ("time", "snr", "rssi", "freq", "lat", "lon", "alt", "hdop", "sats", "provider"),
        _LEVEL,
        "https://ttnmapper.org, export of a user; header and two rows quoted in a public README",
        {**_UNITS, "time_zone": "UTC"},
        caution=_MAPPER + ". Times are taken for UTC. alt may be 0 where the node has no height"),
    *_things_stack(""),
    *_things_stack("result."),
    Format(
        "chirpstack-mapper", "ChirpStack 4, uplink events of a node that sends its position "
                             "(JSON lines)",
        {"level": "rxInfo.rssi", "snr": "rxInfo.snr", "time": "time",
         "device": "rxInfo.gatewayId", "receiver": "deviceInfo.devEui",
         "latitude": "object.latitude", "longitude": "object.longitude",
         "altitude": "object.altitude", "device_latitude": "rxInfo.location.latitude",
         "device_longitude": "rxInfo.location.longitude",
         "device_altitude": "rxInfo.location.altitude"},
        ("rxInfo.rssi", "rxInfo.gatewayId", "deviceInfo.devEui", "object.latitude",
         "object.longitude"),
        _LEVEL, _CHIRPSTACK, _UNITS, caution=_MAPPER),
    Format(
        "chirpstack", "ChirpStack 4, uplink events (JSON lines)",
        {"level": "rxInfo.rssi", "snr": "rxInfo.snr", "time": "time",
         "device": "deviceInfo.devEui", "receiver": "rxInfo.gatewayId",
         "latitude": "rxInfo.location.latitude", "longitude": "rxInfo.location.longitude",
         "altitude": "rxInfo.location.altitude"},
        ("rxInfo.rssi", "rxInfo.gatewayId", "deviceInfo.devEui"),
        _LEVEL, _CHIRPSTACK, _UNITS, caution=_CAUTION),
    Format(
        "semtech-udp", "Semtech UDP packet forwarder, rxpk (JSON lines)",
        {"level": "rxpk.rssi", "snr": "rxpk.lsnr", "time": "rxpk.time"},
        ("rxpk.rssi", "rxpk.freq", "rxpk.datr", "rxpk.tmst"),
        _LEVEL, "https://github.com/Lora-net/packet_forwarder/blob/master/PROTOCOL.TXT", _UNITS,
        caution=_CAUTION + ". The node's address is within the packet: name it by "
                           "--columns 'device=always NAME', and the gateway's place by "
                           "--receivers"),
)
