"""CCSDS messages for orbit determination: tracking data, ephemerides, states; as text (KVN)."""
