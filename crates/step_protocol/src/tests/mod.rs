mod diagram;
mod executor;
mod gate;
mod operator;
mod planner;
mod schedules;
mod tracker;
