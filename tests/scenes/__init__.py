"""What tests share: made-up skies, logs, datasets and servers."""
