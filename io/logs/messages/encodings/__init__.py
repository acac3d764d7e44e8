"""The encodings of messages, a module each; `registry` lists them."""
