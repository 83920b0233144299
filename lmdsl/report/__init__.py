"""One page that tells all about a result and needs no network: plain data first, then HTML."""
