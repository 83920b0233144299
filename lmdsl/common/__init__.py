"""What every package uses and no control engineer needs to know: files, strict models, inputs."""
