"""Stage `track`: detections to tracklets, tracklets to tracks."""
