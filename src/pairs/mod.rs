//! Samples from stores and tables.
//!
//! [`links`] reads a store: one set of samples per ordered link and class, delivered and lost apart. [`table()`] reads
//! anybody's table, in any form of [`crate::storage::TableForm`]: one set from named columns, or [`all_pairs`] of them.
//! [`lagged`] moves y in time.

mod error;
mod lag;
mod store;
mod table;

pub use error::PairsError;
pub use lag::lagged;
pub use store::links;
pub use table::{TableOptions, all_pairs, is_store, table};
