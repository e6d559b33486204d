"""OpenIGTLink: a codec (bytes in, messages out), a link of many peers, and the scene between them and the plane."""
