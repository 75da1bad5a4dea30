"""Effects that a scene may call for, one file each."""
