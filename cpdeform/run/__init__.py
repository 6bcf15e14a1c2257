"""From names and files to a plan and its record: configuration, the resolver, recording, resuming, evaluation."""
