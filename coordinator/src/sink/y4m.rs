//! YUV4MPEG2: raw video that every encoder reads from a file or a pipe.
//!
//! 4:4:4, so that nothing but rounding is lost and odd sizes are natural; limited range,
//! which is what readers assume and the header says. The format has no field for the
//! matrix: it is BT.709, and a comment says so. `ffmpeg` assumes BT.601 unless told
//! `-vf scale=in_color_matrix=bt709`.

use super::beside::Beside;
use super::rate::Rate;
use super::{Arrivals, Finished, FrameSink, SinkError, Spec, colour};
use std::path::Path;
use terrafarm_common::id::FrameIndex;
use terrafarm_common::image::Rgb8;

/// One `.y4m` file.
pub(super) struct Y4m {
    file: Beside,
    arrivals: Arrivals,
}

impl Y4m {
    pub fn open(output: &Path, spec: Spec) -> Result<Box<dyn FrameSink>, SinkError> {
        let rate = Rate::of(spec.fps, output)?;
        let mut file = Beside::create(output)?;
        let header = format!(
            "YUV4MPEG2 W{} H{} F{}:{} Ip A1:1 C444 XCOLORRANGE=LIMITED XMATRIX=BT709\n",
            spec.width, spec.height, rate.frames, rate.per
        );
        file.write(header.as_bytes())?;
        Ok(Box::new(Y4m { file, arrivals: Arrivals::new(spec) }))
    }
}

impl FrameSink for Y4m {
    fn put(&mut self, frame: FrameIndex, picture: &Rgb8) -> Result<(), SinkError> {
        self.arrivals.admit(frame, picture)?;
        let planes = colour::full(picture);
        self.file.write(b"FRAME\n")?;
        [planes.y, planes.cb, planes.cr].iter().try_for_each(|plane| self.file.write(plane))
    }

    fn finish(self: Box<Self>) -> Result<Finished, SinkError> {
        let output = self.file.target().to_path_buf();
        self.arrivals.all_here(&output)?;
        let bytes = self.file.commit()?;
        Ok(Finished { output, frames: self.arrivals.next, bytes })
    }
}
