//! Samples from stores and tables.
