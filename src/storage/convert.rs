//! From one form to another, episode by episode.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use super::{Options, StorageError, create_with, format_of, names, open};
use crate::io;
use crate::schema::{Episode, Manifest};

/// Writes the episodes of the store `from` into a new one `to`, whose name chooses the form. The manifest stays but for
/// what belongs to the form; the content digest of the new store is compared with the old one's. What viewers draw is
/// written if `options` ask for it, unless `from` could have it and has not. Memory is bounded.
/// When it fails or `stop` turns true, nothing is left; `None` then.
///
/// # Errors
/// [`StorageError`] when `from` is damaged, `to` exists (without `force`), is `from` or lies in a store, or the disk
/// refuses.
pub fn convert(
    from: &Path,
    to: &Path,
    options: Options,
    watch: &mut dyn FnMut(&Manifest, &Episode),
    stop: &AtomicBool,
) -> Result<Option<Manifest>, StorageError> {
    names::refuse_same(from, to)?;
    names::check_output(to, options.force)?;
    let mut source = open(from)?;
    let manifest = source.manifest().clone();
    let options = Options { viewer: options.viewer && (format_of(from).build.viewer)(from), ..options };
    let unsealed = Manifest { task: "convert".to_owned(), ..manifest.unsealed() };
    let mut sink = create_with(to, &unsealed, options)?;
    let mut copy = || -> Result<bool, StorageError> {
        while let Some(episode) = source.next_episode()? {
            if stop.load(Ordering::Relaxed) {
                return Ok(false);
            }
            sink.append(&episode)?;
            watch(&manifest, &episode);
        }
        Ok(true)
    };
    let copied = copy();
    if !matches!(copied, Ok(true)) {
        drop(sink);
        io::remove(&io::partial_path(to))?; // the source has it all
        return copied.map(|_| None);
    }
    let written = sink.finish()?;
    if written.content != manifest.content {
        let message = format!("expected content {}, wrote {}", manifest.content, written.content);
        return Err(StorageError::Damaged { message, path: to.to_owned() });
    }
    Ok(Some(written))
}
