"""Code that several stages share: sightings, lone detections, retries, the task decorator."""
