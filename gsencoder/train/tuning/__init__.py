"""Fine-tuning of vision-language models by low-rank adapters on questions about scenes."""
