"""What every room uses and no control engineer needs to know: files, strict models, inputs."""
