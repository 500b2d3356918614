//! Samples from stores and tables.
//!
//! [`links`] reads a store: one set of samples per ordered link and class, delivered and lost apart. [`table()`] reads
//! anybody's table, in any form of [`crate::storage::TableForm`]: one set from named columns, or [`all_pairs`] of them.
//! [`pass`] goes once over a table that memory does not hold. [`lagged`] moves y in time. [`Known`] writes a table whose information is known.

mod error;
mod known;
mod lag;
mod store;
mod table;

pub use error::PairsError;
pub use known::{Known, is_known};
pub use lag::lagged;
pub use store::links;
pub use table::{Passed, PieceSize, Progress, Sample, TableOptions, all_pairs, is_store, pass, size, table};
