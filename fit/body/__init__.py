"""Body models: the licence-free body's generator, model files, skinning."""
