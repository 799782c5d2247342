mod diagram;
mod gate;
mod operator;
mod planner;
mod schedules;
mod tracker;
