//! Training of a field: one or several members, with checkpoints and a log.

mod checkpoint;
mod field_trainer;
mod init_field;
mod member;
mod pose_choice;
mod time_left;

pub(crate) use init_field::InitField;
pub(crate) use member::{Member, TrainingData};
pub(crate) use pose_choice::train_with_best_poses;
