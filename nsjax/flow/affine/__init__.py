"""The exact flow of models that are affine in the state: one turn of its loop is one arc from event to event."""
