"""What several stages share: spans, sightings, retries."""
