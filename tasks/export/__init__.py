"""What a night's tables say of objects and sensors, as messages for orbit determination need it."""
