"""The served Compute Box with an RG2, over Modbus TCP."""
