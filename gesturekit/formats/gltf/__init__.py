"""glTF 2.0: motion of any skeleton, VRM avatars, and a writer of animated files."""
